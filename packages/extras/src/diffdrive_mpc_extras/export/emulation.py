"""Cost and tracking of one closed loop on the emulated microcontroller."""

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

# An exported controller on QEMU's STM32F4, in closed loop over its serial line, with its instructions counted.


MACHINE = "netduinoplus2"
"""QEMU's name of a board with an STM32F405, a Cortex-M4F."""
_EMULATOR = "qemu-system-arm"
_OPTIONS = f"-M {MACHINE} -nographic -monitor none -serial stdio -icount shift=0,sleep=off".split()
MODES = (Mode.TRACKING, Mode.REUSED_PLAN, Mode.BRAKING, Mode.STOPPED, Mode.FINISHED)
"""In the order of `ddmpc_mode`."""
REPLY_BYTES = 9 * 8


class Reply(NamedTuple):
    """Reply for one tick; `cycles` counts those of its step, if the other side counts."""

    command: FloatArray
    mode: Mode
    reasons: int
    status: int
    iterations: int
    soft_limits: int
    operations: int
    cycles: float


def request_bytes(t: float, measurement: Measurement, hold: Hold | None = None, *, anew: bool = False) -> bytes:
    """Encode the tick at `t` [s]; `anew` starts the reference there."""
    numbers = [t, float(anew), 0.0 if hold is None else 1.0 + hold.failure]
    numbers += [0.0, 0.0, 0.0] if measurement.sent is None else [1.0, *measurement.sent]
    numbers += _stamped(measurement.pose, 3)
    numbers += _stamped(measurement.wheel_twist, 2)
    numbers += _stamped(measurement.yaw_rate, 1)
    return np.array(numbers, dtype="<f8").tobytes()


def read_reply(data: bytes) -> Reply:
    """Undo the changes of the other end."""
    v, omega, mode, *counts, cycles = np.frombuffer(data, dtype="<f8").tolist()
    reasons, status, iterations, soft, operations = map(int, counts)
    return Reply(np.array([v, omega]), MODES[int(mode)], reasons, status, iterations, soft, operations, cycles)


def _stamped(stamped: Stamped | None, size: int) -> list[float]:
    if stamped is None:
        return [0.0] * (3 + size + size * size)
    known = stamped.covariance is not None
    covariance = stamped.covariance if known else np.zeros(size * size)
    return [1.0, stamped.time, *_flat(stamped.value), float(known), *_flat(covariance)]


def _flat(values: ArrayLike | None) -> list[float]:
    return np.ravel(np.asarray(values, dtype=float)).tolist()


class EmulatedController:
    """Drives the program in `image`; satisfies `models.interface.TrackingController`. The reference is its own table.

    Parameters
    ----------
    image
        The linked STM32F4 program.

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
        """Of every tick since the last start; `cycles` are instructions."""
        self._anew = True
        greeting = self._read(8)
        self._per_tick = 1e6 / float(memoryview(greeting).cast("d")[0])

    def __enter__(self) -> EmulatedController:
        """Return the controller itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End the emulator."""
        self._process.kill()
        self._process.communicate()

    def start(self, reference: Reference, t0: float) -> None:
        """Start anew at the next tick, whose time is that of the start."""
        del reference, t0
        self._anew, self.replies = True, []

    def step(self, t: float, measurement: Measurement) -> PeerStep:
        """Decide the command for the tick at `t` [s]; raises ConfigError if the program does not reply."""
        began = time.perf_counter()
        assert self._process.stdin is not None
        self._process.stdin.write(request_bytes(t, measurement, anew=self._anew))
        self._process.stdin.flush()
        self._anew = False
        reply = read_reply(self._read(REPLY_BYTES))
        self.replies.append(reply._replace(cycles=reply.cycles * self._per_tick))
        return PeerStep(reply.command, reply.mode, "", time.perf_counter() - began)

    def _read(self, count: int) -> bytes:
        assert self._process.stdout is not None
        data = self._process.stdout.read(count)
        if len(data) < count:
            raise ConfigError(f"--emulate: the program on {_EMULATOR} does not answer")
        return data


_PLANT, _SEED = "mujoco", 0
# Reference for the commands: the same problem, solved to convergence.
_EXACT = {"solver.tolerance": 1e-9, "solver.max_iterations": 100_000}


@dataclass(frozen=True)
class Emulation:
    """One drive along the whole reference, with the default sensors.

    Attributes
    ----------
    steps
        Ticks.
    instructions
        (steps,) of each step.
    iterations
        (steps,) of the active set; 0 where no limit is active.
    operations
        The most of one step, counted as `mpc.solver.report.SolverReport.operations`.
    modes
        Number of steps in each mode of the controller.
    position_rmse
        Against the true pose [m].
    difference
        Largest difference of a command to that of the Python controller for the same measurements [m/s, rad/s].
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
    """Drive the MuJoCo robot along `reference` with the program `image`, and the Python controller beside it.

    Raises ConfigError if QEMU is not installed.
    """
    plant = make_plant(_PLANT, surface="default", sensors="default", seed=_SEED, sample_time=config.sample_time)
    with EmulatedController(image) as controller:
        run = simulate(controller, plant, reference, on_tick=on_tick)
        replies = controller.replies
    beside = Controller(replace_values(config, {"reentry.enabled": False, **_EXACT}))
    beside.start(reference, 0.0)
    commands = [
        beside.step(float(t), measurement).command for t, measurement in zip(run.time, run.measurements, strict=True)
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
