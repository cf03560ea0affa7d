"""Tyres twist before a skid-steer turns: after each change of direction the body lags its wheels by a fixed angle."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from models.checked_yaml import StrictModel
from models.interface import FloatArray


class YawRelaxation(StrictModel):
    """First-order relaxation over the angle through which the wheels turn, not over time.

    With the wheels' yaw rate omega (as it is once settled) and the strain z of the tyres, -1 to 1:

        z' = (omega - |omega| z) / angle,     yaw rate of the body = |omega| z = omega - angle z'.

    So the body's heading is that of the wheels less `angle` times z, and each reversal costs twice `angle`. It is
    Dahl's friction model ("A solid friction model", 1968) between the wheels' heading and the body's.
    """

    angle: float = Field(gt=0, description="turn of the wheels over which the tyres twist [rad of yaw]")

    def advance(self, strain: float, yaw_rate: float, dt: float) -> tuple[float, float]:
        """One sample under a constant yaw rate of the wheels, exactly.

        Parameters
        ----------
        strain
            z at the start, -1 to 1.
        yaw_rate
            Yaw rate of the wheels [rad/s].
        dt
            Sample time [s].

        Returns
        -------
        tuple
            z at the end, and the mean yaw rate of the body over the sample [rad/s].
        """
        side = float(np.sign(yaw_rate))
        end = side + (strain - side) * float(np.exp(-abs(yaw_rate) * dt / self.angle))
        return end, yaw_rate - self.angle * (end - strain) / dt

    def gain(self, strain: float, yaw_rate: float) -> float:
        """Yaw rate of the body over that of the wheels: 1 once settled, negative just after a reversal."""
        return strain * float(np.sign(yaw_rate))

    def follow(self, yaw_rates: ArrayLike, dt: float, strain: float) -> FloatArray:
        """Yaw rates (K,) of the body [rad/s] for those of the wheels (K,), straight lines between samples of `dt` [s].

        `strain` is z at the first sample; 0 for tyres without twist, the sign of the yaw rate for a settled turn.
        """
        rates = np.asarray(yaw_rates, dtype=float)
        body = np.empty_like(rates)
        for k, rate in enumerate(rates):
            if k:
                strain, _ = self.advance(strain, 0.5 * float(rates[k - 1] + rate), dt)
            body[k] = abs(rate) * strain
        return body
