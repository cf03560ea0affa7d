"""A tick of an exported controller as numbers over a line; the other end is stm32f4/frames.h of the exported folder."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from diffdrive_mpc.models.interface import FloatArray, Measurement, Stamped
from diffdrive_mpc.mpc import Mode
from diffdrive_mpc.mpc.hold import Hold

MODES = (Mode.TRACKING, Mode.REUSED_PLAN, Mode.BRAKING, Mode.STOPPED, Mode.FINISHED)
"""In the order of `ddmpc_mode`."""
ANSWER_BYTES = 8 * 8


class Answer(NamedTuple):
    """What comes back of one tick; `cycles` counts those of its step, where the other end counts."""

    command: FloatArray
    mode: Mode
    reasons: int
    status: int
    iterations: int
    soft_limits: int
    cycles: float


def request_bytes(t: float, measurement: Measurement, hold: Hold | None = None, *, anew: bool = False) -> bytes:
    """The tick at `t` [s]; `anew` starts the reference there."""
    numbers = [t, float(anew), 0.0 if hold is None else 1.0 + hold.failure]
    numbers += [0.0, 0.0, 0.0] if measurement.sent is None else [1.0, *measurement.sent]
    numbers += _stamped(measurement.pose, 3)
    numbers += _stamped(measurement.wheel_twist, 2)
    numbers += _stamped(measurement.yaw_rate, 1)
    return np.array(numbers, dtype="<f8").tobytes()


def read_answer(data: bytes) -> Answer:
    """Undo what the other end did."""
    v, omega, mode, reasons, status, iterations, soft, cycles = np.frombuffer(data, dtype="<f8").tolist()
    return Answer(np.array([v, omega]), MODES[int(mode)], int(reasons), int(status), int(iterations), int(soft), cycles)


def _stamped(stamped: Stamped | None, size: int) -> list[float]:
    if stamped is None:
        return [0.0] * (3 + size + size * size)
    known = stamped.covariance is not None
    covariance = stamped.covariance if known else np.zeros(size * size)
    return [1.0, stamped.time, *_flat(stamped.value), float(known), *_flat(covariance)]


def _flat(values: ArrayLike | None) -> list[float]:
    return np.ravel(np.asarray(values, dtype=float)).tolist()
