"""Estimate of pose, velocity and slip at one tick."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.mpc.core.tick import ResultLayout
from diffdrive_mpc.mpc.problem.slip import SLIPS, Slip

SENSORS = ("wheel_speed", "wheel_yaw_rate", "yaw_rate", "pose")
"""Names of the sensors, in the order of the filter."""


class Estimate:
    """Estimate of the filter, whose state is (model states, slip, gyro bias, delays, pose).

    Parameters
    ----------
    layout, block
        Layout of the core's result, and a copy of the result's values; the arrays of the properties are views of it.
    time
        Time of the tick [s].
    """

    __slots__ = ("_block", "_layout", "time")

    def __init__(self, layout: ResultLayout, block: FloatArray, time: float) -> None:
        self._layout, self._block, self.time = layout, block, time

    def __repr__(self) -> str:
        """Return time, pose and twist in one line."""
        (x, y, theta), (v, omega) = self.pose.tolist(), self.twist.tolist()
        return f"Estimate at {self.time:g} s: {x:.3f} m {y:.3f} m {theta:.3f} rad, {v:.3f} m/s {omega:.3f} rad/s"

    @property
    def pose_age(self) -> float:
        """Time since the stamp of the last accepted pose [s]."""
        return float(self._layout.take(self._block, "pose_age")[0])

    @property
    def mean(self) -> FloatArray:
        """(n + 16,) or (n + 21,) mean of the filter's state: model states, slip, gyro bias, delays and pose."""
        return self._layout.take(self._block, "mean")

    @property
    def deviation(self) -> FloatArray:
        """(n + 16,) or (n + 21,) standard deviations of the filter's state."""
        return self._layout.take(self._block, "deviation")

    @property
    def pose(self) -> FloatArray:
        """(3,) x [m], y [m], theta [rad, unwrapped]."""
        return self.mean[-3:]

    @property
    def pose_deviation(self) -> FloatArray:
        """(3,) standard deviations of the pose [m, m, rad]."""
        return self.deviation[-3:]

    @property
    def twist(self) -> FloatArray:
        """(2,) v [m/s], omega [rad/s] of the body, including slip."""
        return self._layout.take(self._block, "twist")

    @property
    def twist_deviation(self) -> FloatArray:
        """(2,) standard deviations of the twist [m/s, rad/s]."""
        return self._layout.take(self._block, "twist_deviation")

    @property
    def slip(self) -> Slip:
        """Slip, the difference between the model's twist and that of the body."""
        return Slip(*self.mean[self._layout.slip].tolist())

    @property
    def slip_deviation(self) -> Slip:
        """Standard deviations of the slip; zero for slip parameters that are not estimated."""
        return Slip(
            **dict.fromkeys(SLIPS, 0.0) | dict(zip(SLIPS, self.deviation[self._layout.slip].tolist(), strict=False))
        )

    @property
    def gyro_bias(self) -> float:
        """Bias of the gyro [rad/s]."""
        # With flat and with curved slip, the last six entries of the state are the bias, two delays and the pose.
        return float(self.mean[-6])

    @property
    def delays(self) -> FloatArray:
        """(2,) estimated delays of v and omega in addition to those of the model [s]."""
        return self.mean[-5:-3]

    @property
    def state(self) -> FloatArray:
        """(n,) states of the velocity model."""
        return self.mean[: self._layout.slip.start]

    @property
    def innovations(self) -> Mapping[str, float]:
        """Latest normalised innovation squared [-], by sensor; its mean is 1 if the noise model is valid."""
        values = zip(SENSORS, self._layout.take(self._block, "innovations").tolist(), strict=True)
        return {sensor: value for sensor, value in values if not np.isnan(value)}


@dataclass(frozen=True, slots=True, eq=False)
class Belief:
    """Mean and covariance of the filter's state at one tick, see `Controller.belief`.

    Attributes
    ----------
    mean
        (Z,) mean in the order and units of `Estimate.mean`, with Z = n + 16 or n + 21.
    covariance
        (Z, Z) covariance.
    sent
        (W, 2) pending commands v_ref [m/s], omega_ref [rad/s] sent before this tick, oldest first.
    states
        Number n of states of the velocity model.
    """

    mean: FloatArray
    covariance: FloatArray
    sent: FloatArray
    states: int

    @property
    def slips(self) -> slice:
        """Slice of the slip in the filter's state: the first 10 of `SLIPS`, or all 15 with curved slip."""
        return slice(self.states, len(self.mean) - 6)

    @property
    def pose(self) -> FloatArray:
        """(3,) x [m], y [m], theta [rad, unwrapped]."""
        return self.mean[-3:]

    @property
    def pose_covariance(self) -> FloatArray:
        """(3, 3) covariance of x, y, theta."""
        return self.covariance[-3:, -3:]

    @property
    def slip(self) -> Slip:
        """Slip, the difference between the model's twist and that of the body."""
        return Slip(*self.mean[self.slips].tolist())

    @property
    def slip_covariance(self) -> FloatArray:
        """(15, 15) covariance of the slip in the order of `SLIPS`; zero for slip parameters that are not estimated."""
        covariance, size = np.zeros((len(SLIPS), len(SLIPS))), self.slips.stop - self.slips.start
        covariance[:size, :size] = self.covariance[self.slips, self.slips]
        return covariance

    @property
    def polynomial_covariance(self) -> FloatArray:
        """(9, 9) first-order covariance of `Slip.polynomial`, the nine coefficients of Ordonez et al., 2017 (P4)."""
        gradient = self.slip.polynomial_gradient
        return gradient @ self.slip_covariance @ gradient.T
