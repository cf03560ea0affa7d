"""Feed-forward constants: the command that would keep the reference's twist, one lag ahead."""

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

    A command takes effect one lag later (dead time and dynamics), so it must match the reference's twist at that time.

    Attributes
    ----------
    inverse_gain
        (2, 2) inverse of the model's steady-state gain.
    whole, rest
        (2,) lag of each channel in whole samples, and its remainder [samples].
    """

    inverse_gain: FloatArray
    whole: NDArray[np.int64]
    rest: FloatArray

    @classmethod
    def from_model(cls, model: VelocityModel | NonlinearModel, dt: float) -> FeedForward:
        """Build the feed-forward of a model at the sample time `dt` [s]."""
        # A zero close to the origin can make a lag negative, but past twists of the reference cannot be followed.
        ahead = np.maximum(model.lag, 0.0) / dt
        whole = np.floor(ahead).astype(np.int64)
        return cls(np.asarray(np.linalg.inv(model.dc_gain), dtype=np.float64), whole, ahead - whole)
