"""`doctor` prints one line for each check, with a remedy where it fails, and fails only without a controller."""

from __future__ import annotations

import subprocess
import sys

import pytest

from commands import invoke
from diffdrive_mpc.app import doctor
from diffdrive_mpc.app.cli import app
from diffdrive_mpc.models.compiled import compiler


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
def test_dependency_out_of_range_is_missing(requirement: str, fault: str, monkeypatch) -> None:
    monkeypatch.setattr(doctor, "requires", lambda name: [requirement])
    check = checks()["dependencies"]
    assert (check.is_ok, fault in check.finding) == (not fault, True)
    assert check.line.startswith("OK" if check.is_ok else "MISSING")
    assert ("pip install --upgrade" in check.line) == bool(fault)


def test_broken_controller_ends_with_exit_code_1(monkeypatch) -> None:
    def broken(*arguments: object) -> None:
        raise RuntimeError("no core\nof any kind")

    monkeypatch.setattr("diffdrive_mpc.mpc.load_config", broken)
    lines = invoke(app, "doctor", code=1).stdout.splitlines()
    assert lines[3].startswith("MISSING controller") and "RuntimeError: no core of any kind; report this" in lines[3]


def test_missing_compiler_is_a_warning_with_a_remedy(monkeypatch) -> None:
    monkeypatch.setattr(compiler, "find_compiler", no_compiler)
    line = doctor._compiler().line
    assert line.startswith("WARN") and "apt install gcc" in line


def no_compiler() -> None:
    raise compiler.NotCompiledError("there is no compiler")


@pytest.mark.parametrize(
    ("distribution", "code", "words"),
    [
        ("", 0, "rclpy with rmw_of_a_test"),
        ("", 1, "diffdrive-mpc[ros]"),
        ("jazzy", 1, "--system-site-packages"),
    ],
)
def test_ros_is_probed_in_another_process(distribution: str, code: int, words: str, monkeypatch) -> None:
    def run(command: list[str], **settings: object) -> subprocess.CompletedProcess[str]:
        assert command[0] == sys.executable
        return subprocess.CompletedProcess(command, code, "rmw_of_a_test\n", "Traceback\nImportError: no rclpy\n")

    monkeypatch.setattr(doctor.subprocess, "run", run)
    monkeypatch.setenv("ROS_DISTRO", distribution)
    check = doctor._ros()
    assert (check.is_ok, check.is_required, words in check.line) == (code == 0, False, True)
    assert check.is_ok or "ImportError: no rclpy" in check.line
