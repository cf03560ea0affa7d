"""`simulate --laps` and `simulate --log`."""

import errno
from dataclasses import replace

import numpy as np
import pytest
import yaml
from typer.testing import CliRunner

from commands import invoke
from diffdrive_mpc import ControllerConfig, identify
from diffdrive_mpc.app.cli import app
from diffdrive_mpc.app.run_log import repeating
from diffdrive_mpc.bench.case import Case
from diffdrive_mpc.models.logs.drive_log.reader import read_drive_log
from diffdrive_mpc.sim import log_mcap
from diffdrive_mpc_extras.rehearsal.lap_parts import lap_parts
from diffdrive_mpc_extras.rehearsal.laps import drive_laps

PLAIN = Case(plant="model:sm", trajectory="cane")
LEARNING = PLAIN.with_override("rehearsal.enabled", value=True)


@pytest.fixture(scope="module")
def plain():
    return drive_laps(PLAIN, 2).runs


def test_laps_have_other_noise_and_repeat_bit_for_bit(plain):
    one, two = drive_laps(LEARNING, 2).runs, drive_laps(LEARNING, 2).runs
    assert all(np.array_equal(a.true_pose, b.true_pose) for a, b in zip(one, two, strict=True))
    assert np.array_equal(one[0].true_pose, plain[0].true_pose)
    assert not np.array_equal(plain[0].measured_pose, plain[1].measured_pose)
    assert not np.array_equal(one[1].command, plain[1].command)


def test_the_parts_of_made_up_laps_are_those_that_were_put_in(plain):
    run, rng = plain[0], np.random.default_rng(0)
    laps = []
    for _ in range(8):
        pose = run.reference_pose + [0.003, 0.004, 0.0]
        pose[:, :2] += 0.002 * rng.standard_normal(pose[:, :2].shape)
        laps.append(replace(run, true_pose=pose))
    parts = lap_parts(laps)
    assert parts.repeating == pytest.approx(0.005, rel=0.02)
    assert parts.other == pytest.approx(0.002 * np.sqrt(2), rel=0.05)


def test_one_lap_has_no_parts(plain):
    with pytest.raises(ValueError, match="two or more"):
        lap_parts(plain[:1])


def test_another_floor_is_driven_no_worse_than_without():
    """Learned on one floor, then all slip is another: at most 10 % worse than without, in any lap."""
    floors = ["default"] * 2 + ["slippery"] * 2
    learned, without = (drive_laps(case, 4, surfaces=floors).runs for case in (LEARNING, PLAIN))
    for ours, other in zip(learned[2:], without[2:], strict=True):
        assert ours.metrics.position_rmse_m < 1.1 * other.metrics.position_rmse_m


def test_the_command_prints_a_row_for_each_lap_and_draws(tmp_path):
    words = ["simulate", "--plant", "model:sm", "--trajectory", "cane", "--laps", "2", "--out", str(tmp_path / "out")]
    result = invoke(app, *words)
    assert "learned from 1 laps" in result.output
    assert "do not: the lower bound" in result.output.replace("\n", " ")
    assert (tmp_path / "out" / "laps.png").exists()


def test_by_the_floor_its_correction_is_drawn(tmp_path):
    words = ["simulate", "--plant", "model:ssm", "--surface", "p4_concrete", "--trajectory", "square", "--laps", "2"]
    result = invoke(app, *words, "--set", "rehearsal.by=floor", "--out", tmp_path / "out")
    assert "slip learned from 1 laps" in result.output
    assert (tmp_path / "out" / "laps.png").exists()


WORDS = ["simulate", "--trajectory", "s", "--plant", "model:ssm", "--seed", "3", "--set", "horizon=12"]


def simulated(*words):
    return CliRunner().invoke(app, [*WORDS, *words])


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("logs")
    for name in ("s.csv", "s.mcap"):
        assert simulated("--log", str(folder / name)).exit_code == 0
    return folder


def test_the_file_says_what_was_driven_and_how_to_drive_it_again(logs):
    told = read_drive_log(logs / "s.mcap").metadata
    assert told["case"]["plant"] == "model:ssm" and told["case"]["seed"] == "3"
    assert told["case"]["repeat"] == " ".join(["diffdrive-mpc", *WORDS])
    assert ControllerConfig.model_validate(yaml.safe_load(told["configuration"]["yaml"])).horizon == 12
    assert yaml.safe_load(told["model"]["yaml"])["name"]


def test_it_holds_the_plans_of_its_controller(logs):
    plans = read_drive_log(logs / "s.mcap", plans=True).plans
    assert {len(plan) for plan in plans if plan is not None} == {13}


def test_identify_finds_the_same_in_both(logs):
    one, other = (identify([logs / name], structure="sm") for name in ("s.csv", "s.mcap"))
    sampled, expected = one.model.discretise(0.0202), other.model.discretise(0.0202)
    assert all(
        np.array_equal(getattr(sampled, name), getattr(expected, name)) for name in ("A", "B0", "B1", "C", "delay")
    )
    assert one.config == other.config


@pytest.mark.parametrize("words", [["--laps", "2"], ["--controller", "pursuit"]])
def test_laps_and_peers_are_logged_too(words, tmp_path):
    plain = [word for word in WORDS if words[0] != "--controller" or word not in ("--set", "horizon=12")]
    invoke(app, *plain, *words, "--log", tmp_path / "run.mcap")
    log = read_drive_log(tmp_path / "run.mcap", plans=True)
    assert " ".join(words) in log.metadata["case"]["repeat"]
    assert any(plan is not None for plan in log.plans) == (words[0] == "--laps")


def test_the_line_of_a_case_names_what_is_not_usual():
    assert repeating(Case()) == []
    case = Case(model="sm", trajectory="cane", scaled=True, overrides=(("weights.across", 60.0),))
    words = ["--model", "sm", "--trajectory", "cane", "--scale-to-robot", "--set", "weights.across=60.0"]
    assert repeating(case) == words


def test_a_full_disk_is_one_line_and_leaves_the_old_file(tmp_path, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(log_mcap, "write_ticks", full)
    log = tmp_path / "run.mcap"
    log.write_bytes(b"old")
    result = simulated("--log", str(log))
    assert result.exit_code == 2
    assert result.stderr.splitlines()[-1] == f"error: --log {log}: cannot be written (No space left on device)"
    assert log.read_bytes() == b"old" and list(tmp_path.iterdir()) == [log]
