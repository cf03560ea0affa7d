"""Closed loop with an exported controller on QEMU's STM32F4, over its serial line, with counted instructions."""

from __future__ import annotations

import shutil
import subprocess
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from diffdrive_mpc.bench.peers import PeerStep
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.interface import FloatArray, Measurement, Reference, Stamped
from diffdrive_mpc.mpc import Controller, ControllerConfig, Mode
from diffdrive_mpc.mpc.config.config_file import replace_values
from diffdrive_mpc.mpc.hold import Hold
from diffdrive_mpc.sim import make_plant, simulate

MACHINE = "netduinoplus2"
"""QEMU machine with an STM32F405, a Cortex-M4F."""
_EMULATOR = "qemu-system-arm"
_OPTIONS = f"-M {MACHINE} -nographic -monitor none -serial stdio -icount shift=0,sleep=off".split()
MODES = (Mode.TRACKING, Mode.REUSED_PLAN, Mode.BRAKING, Mode.STOPPED, Mode.FINISHED)
"""Modes in the order of the C enumeration `ddmpc_mode`."""
REPLY_BYTES = 9 * 8


class Reply(NamedTuple):
    """Reply for one tick; `cycles` are those of the step, or 0 if the program does not count them."""

    command: FloatArray
    mode: Mode
    reasons: int
    status: int
    iterations: int
    soft_limits: int
    operations: int
    cycles: float


def request_bytes(t: float, measurement: Measurement, hold: Hold | None = None, *, restart: bool = False) -> bytes:
    """Encode the request of the tick at `t` [s]; `restart` starts the reference at `t`."""
    frame = [t, float(restart), 0.0 if hold is None else 1.0 + hold.failure]
    frame += [0.0, 0.0, 0.0] if measurement.sent is None else [1.0, *measurement.sent]
    frame += _stamped_values(measurement.pose, 3)
    frame += _stamped_values(measurement.wheel_twist, 2)
    frame += _stamped_values(measurement.yaw_rate, 1)
    return np.array(frame, dtype="<f8").tobytes()


def read_reply(data: bytes) -> Reply:
    """Decode the reply of the program."""
    v, omega, mode, *counts, cycles = np.frombuffer(data, dtype="<f8").tolist()
    reasons, status, iterations, soft, operations = map(int, counts)
    return Reply(np.array([v, omega]), MODES[int(mode)], reasons, status, iterations, soft, operations, cycles)


def _stamped_values(stamped: Stamped | None, size: int) -> list[float]:
    if stamped is None:
        return [0.0] * (3 + size + size * size)
    has_covariance = stamped.covariance is not None
    covariance = stamped.covariance if has_covariance else np.zeros(size * size)
    return [1.0, stamped.time, *_flatten(stamped.value), float(has_covariance), *_flatten(covariance)]


def _flatten(values: ArrayLike | None) -> list[float]:
    return np.ravel(np.asarray(values, dtype=float)).tolist()


class EmulatedController:
    """Exported controller on the emulated board; satisfies `models.interface.TrackingController`.

    The reference is the exported trajectory.

    Parameters
    ----------
    image
        Linked STM32F4 program.

    Raises ConfigError if QEMU is not installed, or the program does not reply.
    """

    def __init__(self, image: Path) -> None:
        if shutil.which(_EMULATOR) is None:
            raise ConfigError(f"--emulate: {_EMULATOR} was not found; install qemu-system-arm")
        self._process = subprocess.Popen(
            [_EMULATOR, *_OPTIONS, "-kernel", str(image)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
        )
        self.replies: list[Reply] = []
        """Reply of each tick since the last start; `cycles` are converted to instructions."""
        self._needs_restart = True
        greeting = self._read(8)
        self._instructions_per_cycle = 1e6 / float(memoryview(greeting).cast("d")[0])

    def __enter__(self) -> EmulatedController:
        """Return the controller."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Terminate the emulator."""
        self._process.kill()
        self._process.communicate()

    def start(self, reference: Reference, t0: float) -> None:
        """Start the exported trajectory at the next tick; both arguments are ignored."""
        del reference, t0
        self._needs_restart, self.replies = True, []

    def step(self, t: float, measurement: Measurement) -> PeerStep:
        """Return the command for the tick at `t` [s]; raise ConfigError if the program does not reply."""
        start = time.perf_counter()
        assert self._process.stdin is not None
        self._process.stdin.write(request_bytes(t, measurement, restart=self._needs_restart))
        self._process.stdin.flush()
        self._needs_restart = False
        reply = read_reply(self._read(REPLY_BYTES))
        self.replies.append(reply._replace(cycles=reply.cycles * self._instructions_per_cycle))
        return PeerStep(reply.command, reply.mode, "", time.perf_counter() - start)

    def _read(self, count: int) -> bytes:
        assert self._process.stdout is not None
        data = self._process.stdout.read(count)
        if len(data) < count:
            raise ConfigError(f"--emulate: the program on {_EMULATOR} stopped without a reply; report this as a bug")
        return data


_PLANT, _SEED = "mujoco", 0
# Solver settings of the Python controller for comparison: solve to convergence.
_EXACT = {"solver.tolerance": 1e-9, "solver.max_iterations": 100_000}


@dataclass(frozen=True)
class Emulation:
    """Result of one drive along the whole reference, with the default sensors.

    Attributes
    ----------
    steps
        Number of ticks.
    instructions
        (steps,) instructions of each step.
    iterations
        (steps,) active-set iterations of each step; 0 if no limit is active.
    operations
        Maximum operations of a step, counted as `mpc.solver.report.SolverReport.operations`.
    modes
        Number of steps in each mode of the controller.
    position_rmse
        RMSE of the true position [m].
    difference
        Maximum difference from a command of the Python controller for the same measurements [m/s, rad/s].
    """

    steps: int
    instructions: np.ndarray[tuple[int], np.dtype[np.float64]]
    iterations: np.ndarray[tuple[int], np.dtype[np.int64]]
    operations: int
    modes: dict[str, int]
    position_rmse: float
    difference: float

    def as_json(self) -> dict[str, object]:
        """Convert to JSON values for export.json."""
        p50, p95, p99 = np.percentile(self.instructions, [50, 95, 99]).round().tolist()
        return {
            "machine": f"qemu {MACHINE}",
            "plant": _PLANT,
            "seed": _SEED,
            "steps": self.steps,
            "instructions_p50": int(p50),
            "instructions_p95": int(p95),
            "instructions_p99": int(p99),
            "instructions_max": int(self.instructions.max()),
            "iterations_max": int(self.iterations.max()),
            "operations_max": self.operations,
            "modes": self.modes,
            "position_rmse_m": self.position_rmse,
            "command_difference_max": self.difference,
        }


def emulate(
    image: Path, config: ControllerConfig, reference: Reference, on_tick: Callable[[int, int], None]
) -> Emulation:
    """Drive the MuJoCo robot with the program `image`, and compare the commands with those of the Python controller.

    Raises ConfigError if QEMU is not installed, or the program does not reply.
    """
    plant = make_plant(_PLANT, surface="default", sensors="default", seed=_SEED, sample_time=config.sample_time)
    with EmulatedController(image) as controller:
        run = simulate(controller, plant, reference, on_tick=on_tick)
        replies = controller.replies
    exact = Controller(replace_values(config, {"reentry.enabled": False, **_EXACT}))
    exact.start(reference, 0.0)
    commands = [
        exact.step(float(t), measurement).command for t, measurement in zip(run.time, run.measurements, strict=True)
    ]
    return Emulation(
        steps=len(replies),
        instructions=np.array([reply.cycles for reply in replies]),
        iterations=np.array([reply.iterations for reply in replies]),
        operations=max(reply.operations for reply in replies),
        modes=dict(Counter(str(reply.mode) for reply in replies)),
        position_rmse=float(run.metrics.position_rmse_m),
        difference=float(np.abs(np.array(commands) - run.command).max()),
    )
