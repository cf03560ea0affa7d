"""`rehearse`: laps with rehearsal and without, their table, figures and log."""

from dataclasses import replace

import numpy as np
import pytest

from commands import invoke
from diffdrive_mpc.app.cli import app
from diffdrive_mpc.bench.case import Case
from diffdrive_mpc.models.logs.drive_log.reader import read_drive_log
from diffdrive_mpc_extras.rehearsal.laps import drive_laps, lap_parts

PLAIN = Case(plant="model:sm", trajectory="cane")
LEARNING = PLAIN.with_override("expert.rehearsal.enabled", value=True)


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


def test_command_writes_a_row_for_each_lap_figures_and_log(tmp_path):
    log = tmp_path / "run.mcap"
    words = ["rehearse", "--plant", "model:sm", "--trajectory", "cane", "--laps", "2", "--out", tmp_path / "out"]
    result = invoke(app, *words, "--log", log)
    assert "learned from 1 laps" in result.output
    assert "do not: the lower bound" in " ".join(result.output.split())
    assert (tmp_path / "out" / "figures" / "laps.png").exists()
    written = read_drive_log(log, plans=True)
    assert written.metadata["case"]["repeat"].startswith("diffdrive-mpc rehearse --laps 2 ")
    assert any(plan is not None for plan in written.plans)


def test_correction_learned_from_slip_is_drawn(tmp_path):
    words = ["rehearse", "--plant", "model:ssm", "--surface", "p4_concrete", "--trajectory", "square", "--laps", "2"]
    result = invoke(app, *words, "--set", "expert.rehearsal.by=floor", "--out", tmp_path / "out")
    assert "slip learned from 1 laps" in " ".join(result.output.split())
    assert (tmp_path / "out" / "figures" / "laps.png").exists()
