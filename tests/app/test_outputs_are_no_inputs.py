"""No command replaces a file that it reads, under any path to the file."""

import errno
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml

from commands import invoke, refusal
from diffdrive_mpc import ControllerConfig
from diffdrive_mpc.app.cli import app
from diffdrive_mpc.models.input_file import read_input, record_inputs
from diffdrive_mpc.models.load import model_path
from diffdrive_mpc.models.logs.drive_log.reader import read_drive_log
from diffdrive_mpc.models.logs.mcap_file import MCAP_MAGIC
from diffdrive_mpc.models.typed_command import named_inputs
from diffdrive_mpc.models.whole_file import whole_file
from diffdrive_mpc.sim import log_mcap

_POSES = "t,x,y,theta\n" + "".join(f"{0.1 * i:.1f},{0.02 * i:.2f},0,0\n" for i in range(50))


@pytest.mark.parametrize("link", [None, os.symlink, os.link])
def test_simulate_does_not_replace_the_trajectory_that_it_drives(tmp_path: Path, link: Callable | None) -> None:
    """The command is refused before the drive, and the file is unchanged."""
    file = tmp_path / "poses.csv"
    file.write_text(_POSES, encoding="utf-8")
    log = tmp_path / "link.csv" if link else file
    if link:
        link(file, log)
    line = refusal("simulate", "--trajectory", file, "--log", log)
    assert "this command reads this file" in line
    assert "--log" in line
    assert file.read_text(encoding="utf-8") == _POSES


def test_file_named_by_another_input_file_is_not_replaced(tmp_path: Path) -> None:
    """The model of a configuration is known only after the configuration has been read."""
    model = tmp_path / "model.csv"
    shutil.copyfile(model_path("ssm"), model)
    content = model.read_bytes()
    config = tmp_path / "config.yaml"
    config.write_text(f"model: {model}\n", encoding="utf-8")
    assert "this command reads this file" in refusal("simulate", "--config", config, "--log", model)
    assert model.read_bytes() == content


def test_output_and_input_of_an_earlier_command_may_be_replaced(tmp_path: Path) -> None:
    """Outputs, and files that only an earlier command has read, are not protected."""
    inputs = ("simulate", "--log", "--trajectory", "b.yaml")
    arguments = ["simulate", "--log", "a.csv", "--trajectory", "b.yaml", "--out=c"]
    assert named_inputs(arguments) == [word for word in inputs for _ in range(2)]
    assert "a.csv" in named_inputs(["twin", "--log", "a.csv"])
    assert {"x.yaml", "y.csv"} <= set(named_inputs(["bench", "--models=x.yaml,y.csv"]))
    assert "z.yaml" in named_inputs(["simulate", "--plant", "mujoco:z.yaml"])
    file = tmp_path / "a.txt"
    file.write_text("old", encoding="utf-8")
    with record_inputs():
        read_input(file, 100)
    with record_inputs(), whole_file(file) as draft:
        draft.write_text("new", encoding="utf-8")
    assert file.read_text(encoding="utf-8") == "new"


COMMAND = ["simulate", "--trajectory", "s", "--plant", "model:ssm", "--seed", "3", "--set", "horizon=12"]


def run_simulate(*arguments, code=0):
    return invoke(app, *COMMAND, *arguments, code=code)


def test_log_states_the_drive_and_its_command(tmp_path):
    run_simulate("--log", tmp_path / "s.mcap")
    metadata = read_drive_log(tmp_path / "s.mcap").metadata
    assert metadata["case"]["plant"] == "model:ssm" and metadata["case"]["seed"] == "3"
    assert metadata["case"]["repeat"] == " ".join(["diffdrive-mpc", *COMMAND])
    assert ControllerConfig.model_validate(yaml.safe_load(metadata["configuration"]["yaml"])).horizon == 12
    assert yaml.safe_load(metadata["model"]["yaml"])["name"]


def test_full_disk_gives_one_line_and_leaves_the_old_file(tmp_path, monkeypatch):
    def fail_on_full_disk(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(log_mcap, "write_ticks", fail_on_full_disk)
    log = tmp_path / "run.mcap"
    log.write_bytes(MCAP_MAGIC + b"old")
    assert (
        run_simulate("--log", log, code=2).stderr.splitlines()[-1]
        == f"error: --log {log}: cannot be written (No space left on device)"
    )
    assert log.read_bytes() == MCAP_MAGIC + b"old" and list(tmp_path.iterdir()) == [log]
