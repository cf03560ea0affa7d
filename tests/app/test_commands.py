"""`doctor` prints one line per check, with a remedy on failure, and fails only without a controller."""

import pytest

from commands import invoke
from diffdrive_mpc.app import doctor
from diffdrive_mpc.app.cli import app, command_line


def checks() -> dict[str, doctor.Check]:
    return {check.name: check for check in doctor.examine()}


def test_installation_passes_and_every_check_is_one_line() -> None:
    lines = invoke(app, "doctor").stdout.splitlines()
    assert lines[0].startswith("diffdrive-mpc ")
    names = ("python", "dependencies", "controller", "compiler", "mujoco", "ROS 2", "CPU governor", "real time")
    assert len(lines) == 1 + len(names)
    assert all(name in line for name, line in zip(names, lines[1:], strict=True))
    assert all(line.startswith("OK ") for line in lines[1:6])
    assert "TRACKING" in lines[3] and "operations" in lines[3]


@pytest.mark.parametrize(
    ("requirement", "fault"),
    [
        ("numpy>=1.26", ""),
        ("numpy>=99", " is not >=99"),
        ("no-such-package", "no-such-package is not installed"),
        ('no-such-package; extra == "tune"', ""),
    ],
)
def test_dependency_outside_its_range_is_reported_missing(requirement: str, fault: str, monkeypatch) -> None:
    monkeypatch.setattr(doctor, "requires", lambda name: [requirement])
    check = checks()["dependencies"]
    assert (check.is_ok, fault in check.finding) == (not fault, True)
    assert check.line.startswith("OK" if check.is_ok else "MISSING")
    assert ("pip install --upgrade" in check.line) == bool(fault)


def test_broken_controller_gives_exit_code_1(monkeypatch) -> None:
    def fail(*arguments: object) -> None:
        raise RuntimeError("no core\nof any kind")

    monkeypatch.setattr("diffdrive_mpc.mpc.load_config", fail)
    lines = invoke(app, "doctor", code=1).stdout.splitlines()
    assert lines[3].startswith("MISSING controller") and "RuntimeError: no core of any kind; report this" in lines[3]


# Commands of packages, with test packages.


@pytest.mark.parametrize("words", [(), ("config",), ("models",), ("log",)])
def test_list_of_commands_shows_their_whole_help(words):
    assert "..." not in invoke(command_line(words), *words, "--help").stdout.replace("[ARGS]...", "")
