"""The exported controller as a process that answers ticks like `mpc.Controller`: for tests."""

from __future__ import annotations

import shutil
import struct
import subprocess
from pathlib import Path

import numpy as np

from diffdrive_mpc import Controller, Measurement, load_config, load_trajectory, make_plant
from diffdrive_mpc.mpc.hold import Hold
from diffdrive_mpc_extras.export.emulation import REPLY_BYTES, Reply, read_reply, request_bytes
from diffdrive_mpc_extras.export.library import Precision, export_controller

HOST = Path(__file__).with_name("export_host.c")
# Some parts ask a controller for sizes that are macros in an export.
STRICT = ("-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Wno-unused-parameter", "-Werror")


def export(
    folder: Path, trajectory: str, precision: str, overrides: dict, *flags: str, model: object = "ssm", terms=()
) -> Path:
    """Export and compile with the host program, with warnings as errors."""
    folder.mkdir()
    config = load_config(model if isinstance(model, str) else "ssm", {"horizon": 15, **overrides})
    given = None if isinstance(model, str) else model
    reference = load_trajectory(trajectory)
    export_controller(config, reference, folder, Precision(precision), model=given, terms=terms)
    sources = [HOST, folder / "stm32f4" / "frames.c", *sorted((folder / "ddmpc").glob("*.c"))]
    includes = [f"-I{folder / name}" for name in ("ddmpc", "stm32f4")]
    compile_c(*STRICT, *flags, *includes, *map(str, sources), "-lm", "-o", str(folder / "host"))
    return folder / "host"


def compile_c(*arguments: str) -> None:
    assert shutil.which("gcc"), "gcc was not found: install a C compiler (Debian: apt-get install gcc libc6-dev)"
    result = subprocess.run(["gcc", *arguments], capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr


class ExportedController:
    """Drives the host program; `start` and `step` are those of `mpc.Controller`."""

    def __init__(self, program: Path) -> None:
        self._process = subprocess.Popen(
            [str(program)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE
        )
        self._anew = True
        self.spoiled_from = np.inf
        """Time of the reference from which on its poses are NaN [s]."""

    def start(self, reference, t0: float) -> None:
        self._anew = True

    def step(self, t: float, measurement: Measurement, hold: Hold | None = None) -> Reply:
        frame = struct.pack("<d", self.spoiled_from) + request_bytes(t, measurement, hold, anew=self._anew)
        self._anew = False
        self._process.stdin.write(frame)
        self._process.stdin.flush()
        data = self._process.stdout.read(REPLY_BYTES)
        assert len(data) == REPLY_BYTES, self._process.communicate()[1].decode()
        return read_reply(data)

    def close(self) -> None:
        """End the process; it must have nothing to complain of."""
        _, complaints = self._process.communicate(timeout=10)
        assert self._process.returncode == 0, complaints.decode()


class SpoiledReference:
    """A trajectory whose poses are NaN from `spoiled_from` [s] on."""

    def __init__(self, name: str) -> None:
        self._inner = load_trajectory(name)
        self.name, self.duration, self.spoiled_from = name, self._inner.duration, np.inf

    def sample(self, times):
        sample = self._inner.sample(times)
        sample.pose[np.asarray(times, dtype=float) >= self.spoiled_from] = np.nan
        return sample


def drive_both(
    program: Path,
    trajectory: str,
    overrides: dict,
    ticks: int,
    *,
    offset=(0.0, 0.0, 0.0),
    change=None,
    model: object = "ssm",
    terms=(),
):
    """The Python controller drives a noisy robot, and the exported one sees the same; both give their steps.

    `change(k, measurement, exported, reference)` may spoil things and returns time shift, measurement and hold.
    """
    named = isinstance(model, str)
    config = load_config(model if named else "ssm", {"horizon": 15, "reentry.enabled": False, **overrides})
    controller, exported = Controller(config, None if named else model, terms), ExportedController(program)
    reference = SpoiledReference(trajectory)
    start = reference.sample([0.0]).pose[0] + offset
    robot = make_plant("model:ssm", seed=0)
    robot.reset(start)
    controller.start(reference, 0.0)
    exported.start(reference, 0.0)
    steps = []
    for k in range(ticks):
        shift, measurement, hold = 0.0, robot.measure(), None
        if change is not None:
            shift, measurement, hold = change(k, measurement, exported, reference)
        t = robot.time + shift
        steps.append((controller.step(t, measurement, hold), exported.step(t, measurement, hold)))
        robot.advance(steps[-1][0].command)
    exported.close()
    return steps


def differences(steps) -> np.ndarray:
    """(n, 2) of the commands."""
    return np.array([ours.command - theirs.command for ours, theirs in steps])
