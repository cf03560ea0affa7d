"""Which wheel speeds and yaw rates may be believed: stamps, numbers, ranges, and single spikes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from models.interface import Measurement, Stamped
from mpc.config import Estimator
from mpc.measurement_check import covariance, numbers, stamp_fault


@dataclass(frozen=True)
class CheckedTwist:
    """One channel of a measured twist: row 0 is v, row 1 is omega; value, variance and stamp [s]."""

    row: int
    value: float
    variance: float
    stamp: float


class _Channel:
    """One sensor; its value is the first of `size` numbers."""

    def __init__(self, row: int, name: str, size: int, noise: float, largest: float, jump: float) -> None:
        self._row, self._name, self._size = row, name, size
        self._variance, self._largest, self._jump = noise**2, largest, jump
        self._stamp, self._last = -np.inf, 0.0

    def check(self, t: float, stamped: Stamped | None, history: float, rejected: list[str]) -> CheckedTwist | None:
        if stamped is None:
            return None
        values = numbers(stamped.value, self._size)
        variance = self._variance
        fault = stamp_fault(stamped.time, t, self._stamp, history)
        if values is None:
            fault = "not finite" if self._size == 1 else f"not {self._size} finite numbers"
        elif abs(values[0]) > self._largest:
            fault = f"{values[0]:.3g} is more than {self._largest:g}"
        elif stamped.covariance is not None:
            matrix = covariance(stamped.covariance, self._size)
            if matrix is None:
                fault = "its covariance is not a possible one"
            else:
                variance = float(matrix[0, 0])
        if not fault and values is not None:
            value, before = float(values[0]), self._last
            self._stamp, self._last = float(stamped.time), value
            # A wheel that hits a wall does jump, and stays where it is: the next sample confirms it.
            if abs(value - before) <= self._jump:
                return CheckedTwist(self._row, value, variance, self._stamp)
            fault = f"it jumps from {before:.2f} to {value:.2f}"
        rejected.append(f"{self._name} rejected: {fault}")
        return None


class TwistGate:
    """Checks encoders and gyro."""

    def __init__(self, settings: Estimator) -> None:
        self._settings = settings
        self.reset()

    def reset(self) -> None:
        """Forget every value, as of a robot at rest."""
        s = self._settings
        self._wheels = _Channel(0, "wheel speed", 2, s.wheel_speed_noise, s.max_wheel_speed, s.max_wheel_speed_jump)
        self._gyro = _Channel(1, "yaw rate", 1, s.yaw_rate_noise, s.max_yaw_rate, s.max_yaw_rate_jump)

    def check(self, t: float, measurement: Measurement, rejected: list[str]) -> list[CheckedTwist]:
        """What can be used; a sentence in `rejected` for each that cannot."""
        history = self._settings.history
        checked = (
            self._wheels.check(t, measurement.wheel_twist, history, rejected),
            self._gyro.check(t, measurement.yaw_rate, history, rejected),
        )
        return [twist for twist in checked if twist is not None]
