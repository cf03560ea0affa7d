"""`doctor` prints one line per check, with a remedy on failure, and fails only without a controller."""

import pytest

from commands import invoke
from diffdrive_mpc.app.cli import app, command_line


def test_installation_passes_and_every_check_prints_one_line() -> None:
    lines = invoke(app, "doctor").stdout.splitlines()
    assert lines[0].startswith("diffdrive-mpc ")
    names = ("python", "dependencies", "controller", "compiler", "mujoco", "ROS 2", "CPU governor", "real time")
    assert len(lines) == 1 + len(names)
    assert all(name in line for name, line in zip(names, lines[1:], strict=True))
    assert all(line.startswith("OK ") for line in lines[1:6])
    assert "TRACKING" in lines[3] and "operations" in lines[3]


def test_broken_controller_gives_exit_code_1(monkeypatch) -> None:
    def fail(*arguments: object) -> None:
        raise RuntimeError("no core\nof any kind")

    monkeypatch.setattr("diffdrive_mpc.mpc.load_config", fail)
    lines = invoke(app, "doctor", code=1).stdout.splitlines()
    assert lines[3].startswith("MISSING controller") and "RuntimeError: no core of any kind; report this" in lines[3]


# List of commands.


@pytest.mark.parametrize("group", [(), ("config",), ("models",), ("log",)])
def test_list_of_commands_is_not_truncated(group):
    assert "..." not in invoke(command_line(group), *group, "--help").stdout.replace("[ARGS]...", "")
