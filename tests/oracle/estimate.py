"""Estimate of the oracle at one tick."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.mpc.estimate import SENSORS
from diffdrive_mpc.mpc.problem.slip import Slip


class Estimate:
    """Vector of all values of an estimate, with properties for its parts.

    Parameters
    ----------
    values
        Time, pose age; mean and standard deviations (n + 16,) of the filter's state, see `oracle.kalman`; twist (2,)
        and its standard deviations (2,); innovations (4,), NaN if missing.
    order
        Order n of the velocity model.
    """

    __slots__ = ("_order", "values")

    def __init__(self, values: FloatArray, order: int) -> None:
        self.values, self._order = values, order

    @property
    def time(self) -> float:
        """Time of the tick [s]."""
        return float(self.values[0])

    @property
    def pose_age(self) -> float:
        """Time since the stamp of the last accepted pose [s]."""
        return float(self.values[1])

    @property
    def mean(self) -> FloatArray:
        """Mean (n + 16,) of the filter's state: states, slip, gyro bias, delays and pose."""
        return self.values[2 : self._order + 18]

    @property
    def deviation(self) -> FloatArray:
        """Standard deviations (n + 16,) of the filter's state."""
        return self.values[self._order + 18 : 2 * self._order + 34]

    @property
    def pose(self) -> FloatArray:
        """Pose (3,): x [m], y [m], theta [rad, unwrapped]."""
        return self.mean[-3:]

    @property
    def pose_deviation(self) -> FloatArray:
        """Standard deviations (3,) of the pose."""
        return self.deviation[-3:]

    @property
    def twist(self) -> FloatArray:
        """Twist (2,) of the body with slip: v [m/s], omega [rad/s]."""
        return self.values[-8:-6]

    @property
    def twist_deviation(self) -> FloatArray:
        """Standard deviations (2,) of the twist."""
        return self.values[-6:-4]

    @property
    def slip(self) -> Slip:
        """Slip between the twists of model and body."""
        return Slip(*self.mean[self._order : self._order + 10].tolist())

    @property
    def slip_deviation(self) -> Slip:
        """Standard deviations of the slip."""
        return Slip(*self.deviation[self._order : self._order + 10].tolist())

    @property
    def gyro_bias(self) -> float:
        """Bias of the gyro [rad/s]."""
        return float(self.mean[-6])

    @property
    def delays(self) -> FloatArray:
        """Delays (2,) of v and omega that the model does not contain [s]."""
        return self.mean[-5:-3]

    @property
    def state(self) -> FloatArray:
        """States (n,) of the velocity model."""
        return self.mean[: self._order]

    @property
    def innovations(self) -> Mapping[str, float]:
        """Newest squared innovation over its variance by sensor: 1 on average if the assumptions hold [-]."""
        pairs = zip(SENSORS, self.values[-4:].tolist(), strict=True)
        return {sensor: value for sensor, value in pairs if not np.isnan(value)}
