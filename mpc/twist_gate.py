"""Which wheel speeds and yaw rates may be believed: stamps, numbers, ranges, and single spikes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from diffdrive_mpc.models.interface import Measurement, Stamped
from diffdrive_mpc.mpc.config.schema import Estimator
from diffdrive_mpc.mpc.measurement_check import covariance, numbers, stamp_fault


@dataclass(frozen=True)
class CheckedTwist:
    """One number of a measured twist: "wheel_speed" [m/s], "wheel_yaw_rate" or "yaw_rate" [rad/s], of the gyro.

    `message` names what it came with.
    """

    message: str
    sensor: str
    value: float
    variance: float
    stamp: float


class _Channels:
    """One message with a number for each of `sensors`: their noise, largest values and largest jumps."""

    def __init__(
        self, name: str, sensors: tuple[str, ...], noise: list[float], largest: list[float], jump: list[float]
    ) -> None:
        self._name, self._sensors, self._size = name, sensors, len(sensors)
        self._variances, self._largest, self._jump = np.square(noise), np.array(largest), np.array(jump)
        self._stamp, self._last = -np.inf, np.zeros(self._size)

    def check(self, t: float, stamped: Stamped | None, history: float, rejected: list[str]) -> list[CheckedTwist]:
        if stamped is None:
            return []
        values = numbers(stamped.value, self._size)
        variances = self._variances
        fault = stamp_fault(stamped.time, t, self._stamp, history)
        if values is None:
            fault = "not finite" if self._size == 1 else f"not {self._size} finite numbers"
        elif (np.abs(values) > self._largest).any():
            at = int(np.argmax(np.abs(values) > self._largest))
            fault = f"{values[at]:.3g} is more than {self._largest[at]:g}"
        elif stamped.covariance is not None:
            matrix = covariance(stamped.covariance, self._size)
            if matrix is None:
                fault = "its covariance is not a possible one"
            else:
                variances = np.diag(matrix)
        if not fault and values is not None:
            before = self._last
            self._stamp, self._last = float(stamped.time), values
            # A wheel that hits a wall does jump, and stays where it is: the next sample confirms it.
            jumps = np.abs(values - before) > self._jump
            if not jumps.any():
                rows = zip(self._sensors, values.tolist(), variances.tolist(), strict=True)
                return [
                    CheckedTwist(self._name, sensor, value, variance, self._stamp) for sensor, value, variance in rows
                ]
            at = int(np.argmax(jumps))
            fault = f"it jumps from {before[at]:.2f} to {values[at]:.2f}"
        rejected.append(f"{self._name} rejected: {fault}")
        return []


class TwistGate:
    """Checks encoders and gyro."""

    def __init__(self, settings: Estimator) -> None:
        self._settings = settings
        self.reset()

    def reset(self) -> None:
        """Forget every value, as of a robot at rest."""
        s = self._settings
        self._wheels = _Channels(
            "wheel speed",
            ("wheel_speed", "wheel_yaw_rate"),
            [s.wheel_speed_noise, s.wheel_yaw_rate_noise],
            [s.max_wheel_speed, s.max_yaw_rate],
            [s.max_wheel_speed_jump, s.max_yaw_rate_jump],
        )
        self._gyro = _Channels("yaw rate", ("yaw_rate",), [s.yaw_rate_noise], [s.max_yaw_rate], [s.max_yaw_rate_jump])

    def check(self, t: float, measurement: Measurement, rejected: list[str]) -> list[CheckedTwist]:
        """What can be used; a sentence in `rejected` for each message that cannot."""
        history = self._settings.history
        return [
            *self._wheels.check(t, measurement.wheel_twist, history, rejected),
            *self._gyro.check(t, measurement.yaw_rate, history, rejected),
        ]
