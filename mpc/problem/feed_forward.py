"""Constants of the feed-forward command, which anticipates the reference's twist by the lag of the robot."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.nonlinear_model import NonlinearModel
from diffdrive_mpc.models.velocity_model import VelocityModel


@dataclass(frozen=True)
class FeedForward:
    """Constants of the feed-forward command.

    A command takes effect after a lag (dead time and dynamics), so it must correspond to the reference's twist one lag
    later.

    Attributes
    ----------
    inverse_gain
        (2, 2) inverse of the model's steady-state gain.
    whole, fraction
        (2,) integer part and fractional part of the lag of each channel [samples].
    """

    inverse_gain: FloatArray
    whole: NDArray[np.int64]
    fraction: FloatArray

    @classmethod
    def from_model(cls, model: VelocityModel | NonlinearModel, dt: float) -> FeedForward:
        """Build the feed-forward of a model at the sample time `dt` [s]."""
        # A transfer zero near the origin can result in a negative lag, for which no causal feed-forward exists.
        lag = np.maximum(model.lag, 0.0) / dt
        whole = np.floor(lag).astype(np.int64)
        return cls(np.asarray(np.linalg.inv(model.dc_gain), dtype=np.float64), whole, lag - whole)
