"""All that the filter believes at one tick, covariances between its parts included."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.mpc.problem.slip import SLIPS, Slip


@dataclass(frozen=True, slots=True, eq=False)
class Belief:
    """Mean and covariance of the filter's state (states, slip, gyro bias, pose), see `Controller.belief`.

    Attributes
    ----------
    mean
        (Z,) in the units of `Estimate.mean`, Z = n + 14 or n + 19.
    covariance
        (Z, Z).
    sent
        (W, 2) commands v_ref [m/s], omega_ref [rad/s] that were on their way before the tick's own, oldest first.
    states
        n, how many states the velocity model has.
    """

    mean: FloatArray
    covariance: FloatArray
    sent: FloatArray
    states: int

    @property
    def slips(self) -> slice:
        """Where slip lies in the state; of `SLIPS` the first 10, or all 15 where the configuration speaks of others."""
        return slice(self.states, len(self.mean) - 4)

    @property
    def pose(self) -> FloatArray:
        """(3,) x [m], y [m], theta [rad, unwrapped]."""
        return self.mean[-3:]

    @property
    def pose_covariance(self) -> FloatArray:
        """(3, 3) of x, y, theta."""
        return self.covariance[-3:, -3:]

    @property
    def slip(self) -> Slip:
        """What lies between the model's twist and that of the body."""
        return Slip(*self.mean[self.slips].tolist())

    @property
    def slip_covariance(self) -> FloatArray:
        """(15, 15) covariance of the slip in the order of `SLIPS`, zero for what the filter does not have."""
        found, size = np.zeros((len(SLIPS), len(SLIPS))), self.slips.stop - self.slips.start
        found[:size, :size] = self.covariance[self.slips, self.slips]
        return found

    @property
    def polynomial_covariance(self) -> FloatArray:
        """(9, 9) covariance of `Slip.polynomial`, the nine terms of Ordonez et al., 2017 (P4), to first order."""
        gradient = self.slip.polynomial_gradient
        return gradient @ self.slip_covariance @ gradient.T

    def with_slip(self, slip: Slip) -> Belief:
        """The same with another slip, taken as certain."""
        mean, covariance = self.mean.copy(), self.covariance.copy()
        mean[self.slips] = [getattr(slip, name) for name in SLIPS[: self.slips.stop - self.slips.start]]
        covariance[self.slips], covariance[:, self.slips] = 0.0, 0.0
        return replace(self, mean=mean, covariance=covariance)
