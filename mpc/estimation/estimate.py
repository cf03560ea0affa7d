"""What the controller believes at one tick."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.mpc.core.tick import ResultLayout
from diffdrive_mpc.mpc.problem.slip import SLIPS, Slip

SENSORS = ("wheel_speed", "wheel_yaw_rate", "yaw_rate", "pose")
"""Names of the sensors, in the order in which the filter counts them."""


class Estimate:
    """One block of numbers, taken apart where it is looked at. The filter's state is (states, slip, gyro bias, pose).

    Parameters
    ----------
    layout, block
        A copy of the core's result, and where what lies in it.
    time
        Time of the tick [s].
    """

    __slots__ = ("_block", "_layout", "time")

    def __init__(self, layout: ResultLayout, block: FloatArray, time: float) -> None:
        self._layout, self._block, self.time = layout, block, time

    @property
    def pose_age(self) -> float:
        """Time since the stamp of the last accepted pose [s]."""
        return float(self._layout.take(self._block, "pose_age")[0])

    @property
    def mean(self) -> FloatArray:
        """(n + 14 or 19,) mean of the filter's state: states, slip, gyro bias and pose."""
        return self._layout.take(self._block, "mean")

    @property
    def deviation(self) -> FloatArray:
        """(n + 14 or 19,) standard deviations of the same."""
        return self._layout.take(self._block, "deviation")

    @property
    def pose(self) -> FloatArray:
        """(3,) x [m], y [m], theta [rad, unwrapped]."""
        return self.mean[-3:]

    @property
    def pose_deviation(self) -> FloatArray:
        """(3,) its standard deviations."""
        return self.deviation[-3:]

    @property
    def twist(self) -> FloatArray:
        """(2,) v [m/s], omega [rad/s] of the body, slip included."""
        return self._layout.take(self._block, "twist")

    @property
    def twist_deviation(self) -> FloatArray:
        """(2,) its standard deviations."""
        return self._layout.take(self._block, "twist_deviation")

    @property
    def slip(self) -> Slip:
        """What lies between the model's twist and that of the body."""
        return Slip(*self.mean[self._layout.slip].tolist())

    @property
    def slip_deviation(self) -> Slip:
        """Its standard deviations."""
        return Slip(
            **dict.fromkeys(SLIPS, 0.0) | dict(zip(SLIPS, self.deviation[self._layout.slip].tolist(), strict=False))
        )

    @property
    def gyro_bias(self) -> float:
        """Bias of the gyro [rad/s]."""
        return float(self.mean[-4])

    @property
    def gyro_bias_deviation(self) -> float:
        """Its standard deviation."""
        return float(self.deviation[-4])

    @property
    def state(self) -> FloatArray:
        """(n,) states of the velocity model."""
        return self.mean[: self._layout.slip.start]

    @property
    def innovations(self) -> Mapping[str, float]:
        """By sensor, the newest squared innovation over its variance: 1 on average where the assumptions hold [-]."""
        found = zip(SENSORS, self._layout.take(self._block, "innovations").tolist(), strict=True)
        return {sensor: value for sensor, value in found if not np.isnan(value)}
