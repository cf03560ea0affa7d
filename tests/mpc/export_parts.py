"""The exported controller as a process that answers ticks like `mpc.Controller`: for tests."""

from __future__ import annotations

import subprocess
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from models import Measurement
from mpc import Mode
from mpc.hold import Hold
from mpc.solver_report import SolverStatus

MODES = (Mode.TRACKING, Mode.REUSED_PLAN, Mode.BRAKING, Mode.STOPPED, Mode.FINISHED)
STATUSES = (
    SolverStatus.SOLVED,
    SolverStatus.SOLVED_INACCURATELY,
    SolverStatus.MAX_ITERATIONS,
    SolverStatus.INFEASIBLE,
    SolverStatus.UNBOUNDED,
    SolverStatus.NOT_CONVEX,
    SolverStatus.NOT_FINITE,
    SolverStatus.REFUSED,
    SolverStatus.NOT_RUN,
)
OURS = ("-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Werror")
INCLUDES = ("ddmpc", "osqp", "osqp/inc/public", "osqp/inc/private", "stm32f4")


@dataclass(frozen=True)
class Answer:
    """What the process says of one tick."""

    command: np.ndarray
    mode: Mode
    reasons: int
    status: SolverStatus
    iterations: int
    soft_limits: int
    left_out: int


def compile_export(folder: Path, main: Path, flags: tuple[str, ...] = ("-O2",)) -> Path:
    """Build `main` with the exported `folder`: our sources with warnings as errors, OSQP's as they come."""
    includes = [f"-I{folder / name}" for name in INCLUDES]
    ours = [main, folder / "stm32f4" / "frames.c", *(folder / "ddmpc").glob("*.c")]
    groups = {OURS: ours, ("-std=c99", "-w"): [*(folder / "osqp").glob("**/*.c")]}
    place = folder / "objects"
    place.mkdir(exist_ok=True)
    objects = []
    for options, sources in groups.items():
        for source in sources:
            objects.append(str(place / f"{source.stem}.o"))
            build(["gcc", *options, *flags, *includes, "-c", str(source), "-o", objects[-1]])
    program = folder / f"{main.stem}.run"
    build(["gcc", *flags, *objects, "-lm", "-o", str(program)])
    return program


def build(command: list[str]) -> None:
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr


class ExportedController:
    """Drives the host program; `start` and `step` are those of `mpc.Controller`."""

    def __init__(self, program: Path) -> None:
        self._process = subprocess.Popen(
            [str(program)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE
        )
        self._anew = True
        self.spoiled_from = np.inf

    def start(self, reference, t0: float) -> None:
        """Start anew; the reference is that of the table."""
        self._anew = True

    def step(self, t: float, measurement: Measurement, hold: Hold | None = None) -> Answer:
        frame = [self.spoiled_from, *frame_of(t, measurement, hold, anew=self._anew)]
        self._anew = False
        self._process.stdin.write(np.array(frame, dtype="<f8").tobytes())
        self._process.stdin.flush()
        data = self._process.stdout.read(64)
        assert len(data) == 64, self._process.stderr.read().decode()
        return answer_of(np.frombuffer(data, dtype="<f8"))

    def close(self) -> str:
        """End the process; returns what it complained of."""
        _, complaints = self._process.communicate()
        assert self._process.returncode == 0
        return complaints.decode()


def frame_of(t: float, measurement: Measurement, hold: Hold | None, *, anew: bool) -> list[float]:
    request = 0.0 if hold is None else 1.0 + hold.failure
    sent = [0.0, 0.0, 0.0] if measurement.sent is None else [1.0, *measurement.sent]
    frame = [t, float(anew), request, *sent]
    for stamped, size in ((measurement.pose, 3), (measurement.wheel_twist, 2), (measurement.yaw_rate, 1)):
        value = np.zeros(size) if stamped is None else np.ravel(stamped.value)
        frame += [float(stamped is not None), 0.0 if stamped is None else stamped.time, *value]
    return frame


def answer_of(numbers: np.ndarray) -> Answer:
    v, omega, mode, reasons, status, *counts = numbers.tolist()
    iterations, soft, left = (int(count) for count in counts)
    return Answer(np.array([v, omega]), MODES[int(mode)], int(reasons), STATUSES[int(status)], iterations, soft, left)
