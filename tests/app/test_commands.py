"""`doctor` prints one line per check, with a remedy on failure; messages fit the terminal."""

import sys

import pytest

from commands import invoke
from diffdrive_mpc.app.cli import app, command_line
from diffdrive_mpc.app.command_line.echo import echo


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


def test_warning_is_wrapped_on_a_terminal_only(monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "40")
    for is_terminal in (False, True):
        monkeypatch.setattr(sys.stdout, "isatty", lambda is_terminal=is_terminal: is_terminal)
        echo("  table row" + 40 * " -" + "\nwarning: " + 20 * "words ")
        rows, *lines = capsys.readouterr().out.splitlines()
        assert len(rows) > 80 and (max(map(len, lines)) <= 40) == is_terminal == (len(lines) > 1)
