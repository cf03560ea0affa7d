"""`simulate --log`."""

import errno

import numpy as np
import pytest
import yaml
from typer.testing import CliRunner

from commands import invoke
from diffdrive_mpc import ControllerConfig, identify
from diffdrive_mpc.app.cli import app
from diffdrive_mpc.models.logs.drive_log.reader import read_drive_log
from diffdrive_mpc.sim import log_mcap

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


def test_identify_finds_the_same_in_both(logs):
    one, other = (identify([logs / name], structure="sm") for name in ("s.csv", "s.mcap"))
    sampled, expected = one.model.discretise(0.0202), other.model.discretise(0.0202)
    assert all(
        np.array_equal(getattr(sampled, name), getattr(expected, name)) for name in ("A", "B0", "B1", "C", "delay")
    )
    assert one.config == other.config


def test_drive_of_a_peer_is_logged_without_plans(tmp_path):
    words = [word for word in WORDS if word not in ("--set", "horizon=12")]
    invoke(app, *words, "--controller", "pursuit", "--log", tmp_path / "run.mcap")
    log = read_drive_log(tmp_path / "run.mcap", plans=True)
    assert "--controller pursuit" in log.metadata["case"]["repeat"]
    assert all(plan is None for plan in log.plans)


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
