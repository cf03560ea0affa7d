"""Drives of the simulated robot by the node over DDS, each in a separate process."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from diffdrive_mpc.bench.case import Case
from diffdrive_mpc.models.errors import DiffdriveMpcError

_COMMAND = (sys.executable, "-c", "from diffdrive_mpc.app.cli import main; main()")
# Higher ROS domains use ports that operating systems assign to other programs.
_DOMAINS = 101
# Time limit for a process to end after it was interrupted [s].
_END_TIMEOUT = 20.0
# Robot time before the start, while the node gets its first measurements, and after the end [s].
_MARGIN = 2.0
_POLL_PERIOD = 0.05
_MAX_OUTPUT = 1000
# Maximum delay of a command on a busy machine in lock step [s]; a tick without the command would change the drive.
_RESPONSE_TIMEOUT = 20.0


class DriveFailedError(DiffdriveMpcError, RuntimeError):
    """Failure or timeout of one of the two processes; the message contains its name and last output."""


def drive_over_dds(
    case: Case,
    duration: float,
    bag: Path,
    *,
    lock_step: bool,
    timeout: float,
    settings: Path | None = None,
    parameters: Path | None = None,
) -> None:
    """Drive `case` with the node and record it.

    Parameters
    ----------
    case
        Case with the controller "mpc"; model and overrides are passed to the node.
    duration
        Duration of the reference [s].
    bag
        Folder for the recording.
    lock_step
        True if the clock waits for each command; otherwise the drive runs in real time.
    timeout
        Time limit of the drive [s].
    settings
        Settings file of the simulated base; None for the shipped file.
    parameters
        File of the node's parameters; if None, poses come from the topic.

    Raises
    ------
    DriveFailedError
        If a process fails or exceeds the time limit.
    """
    robot = [
        *("sim-robot", "--plant", case.plant, "--surface", case.surface, "--sensors", case.sensors),
        *("--scenario", case.scenario, "--seed", str(case.seed), "--trajectory", case.trajectory),
        *("--answer-timeout", str(_RESPONSE_TIMEOUT)),
        *("--lock-step" if lock_step else "--real-time", "--duration", str(duration + _MARGIN), "--record", str(bag)),
        *(("--base", str(settings)) if settings else ()),
    ]
    node = ["node", "--config", case.config or case.model, "--trajectory", case.trajectory, "--drive"]
    for key, value in case.overrides:
        node += ["--set", f"{key}={value}"]
    node += ["--ros-args", *(("--params-file", str(parameters)) if parameters else ("-p", "use_pose_topic:=true"))]
    node += ["-p", "start_at_robot:=false"]
    node += ["-p", f"use_sim_time:={str(lock_step).lower()}"]
    with tempfile.TemporaryDirectory() as folder:
        environment = own_domain(Path(folder))
        with (
            running("node", node, environment, Path(folder)) as controller,
            running("robot", robot, environment, Path(folder)) as base,
        ):
            _wait(base, controller, time.monotonic() + timeout)


def own_domain(folder: Path) -> dict[str, str]:
    """Return an environment with a separate ROS domain and a temporary folder of logs."""
    return os.environ | {
        "ROS_DOMAIN_ID": str(1 + os.getpid() % _DOMAINS),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "ROS_LOG_DIR": str(folder / "log"),
    }


class Process:
    """Running command of `diffdrive-mpc`.

    Parameters
    ----------
    name
        Name in messages.
    arguments
        Command and options.
    environment
        Environment of the process.
    folder
        Folder for its output.
    """

    def __init__(self, name: str, arguments: Sequence[str], environment: dict[str, str], folder: Path) -> None:
        self.name = name
        self._path = folder / name
        self._log = self._path.open("w", encoding="utf-8")
        self.popen = subprocess.Popen([*_COMMAND, *arguments], env=environment, stdout=self._log, stderr=self._log)

    @property
    def output(self) -> str:
        """Output up to now."""
        return self._path.read_text(encoding="utf-8")

    def failure(self, reason: str) -> DriveFailedError:
        """Return an error with the last output of this process."""
        output = " ".join(self.output.split())[-_MAX_OUTPUT:]
        return DriveFailedError(f"{self.name}: {reason}; output: {output or 'nothing'}")

    def end(self) -> None:
        """Interrupt the process with SIGINT; kill it after a timeout."""
        if self.popen.poll() is None:
            self.popen.send_signal(signal.SIGINT)
            try:
                self.popen.wait(_END_TIMEOUT)
            except subprocess.TimeoutExpired:
                self.popen.kill()
                self.popen.wait()
        self._log.close()


@contextmanager
def running(name: str, arguments: Sequence[str], environment: dict[str, str], folder: Path) -> Iterator[Process]:
    """Yield a process that ends with the context; parameters as for `Process`."""
    process = Process(name, arguments, environment, folder)
    try:
        yield process
    finally:
        process.end()


def _wait(robot: Process, controller: Process, deadline: float) -> None:
    """Wait until the process of the robot ends."""
    while robot.popen.poll() is None:
        if controller.popen.poll() is not None:
            raise controller.failure(f"ended with code {controller.popen.returncode} while the robot was driving")
        if time.monotonic() > deadline:
            raise controller.failure("the drive took too long")
        time.sleep(_POLL_PERIOD)
    if robot.popen.returncode:
        raise robot.failure(f"ended with code {robot.popen.returncode}")
