"""`excite --for model`: the drive, its log, and robots that are not as believed."""

from dataclasses import replace

import numpy as np
import pytest
import yaml

from commands import invoke
from diffdrive_mpc.app.cli import app
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.logs import read_log
from diffdrive_mpc_extras.excitation import model_excitation as searched
from diffdrive_mpc_extras.excitation.excite import check_drive, driven, excite_model
from diffdrive_mpc_extras.excitation.model_excitation import Room


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    settings = searched.model_excitation_settings().model_copy(update={"population": 6, "generations": 2})
    monkeypatch.setattr(searched, "model_excitation_settings", lambda: settings)


def robot(path, gain, dead_time):
    channels = {name: {"gain": gain, "natural_frequency": 14.0, "damping": 1.1} for name in ("v", "omega")}
    content = {
        "name": "other",
        "structure": "sm",
        "provenance": {"origin": "assumed", "source": "this test"},
        "dead_time": {"v": dead_time, "omega": dead_time},
        "channels": channels,
    }
    path.write_text(yaml.safe_dump(content))
    return f"model:{path}"


def drive_of(found, folder, plant):
    return driven(found.on(plant, 1, folder / "drive.yaml"), folder / "drive.yaml")


def test_it_stays_in_its_room_on_robots_of_other_gains(tmp_path):
    found = excite_model("ssm", Room(3.0, 2.0), seconds=20.0)
    found.write(tmp_path / "drive.yaml")
    for gain, dead_time in ((0.7, 0.1), (1.3, 0.02)):
        run = drive_of(found, tmp_path, robot(tmp_path / "other.yaml", gain, dead_time))
        check_drive(run, found.room)
        assert (np.abs(run.true_pose[:, :2]) <= (1.5 - 0.1, 1.0 - 0.1)).all()


def test_a_robot_that_leaves_is_said(tmp_path):
    found = excite_model("ssm", Room(3.0, 2.0), seconds=10.0)
    found.write(tmp_path / "drive.yaml")
    run = drive_of(found, tmp_path, robot(tmp_path / "other.yaml", 1.0, 0.04))
    with pytest.raises(ConfigError, match=r"the robot left its room after \d+\.\d s"):
        check_drive(replace(run, true_pose=run.true_pose + [3.0, 0.0, 0.0]), found.room)


def test_drive_and_log_of_the_command(tmp_path):
    drive, log = tmp_path / "drive.yaml", tmp_path / "drive.csv"
    words = ["excite", "sm", "--for", "model", "--inside", "4x3", "--seconds", "15", "--plant", "model:sm"]
    result = invoke(app, *words, "--log", log, "--out", drive)
    assert "fence: {enabled: true, length: 4, width: 3, frame: start}" in result.output
    read_log(log).require_sound()
