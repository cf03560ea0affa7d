"""The command that would keep the reference's twist: the model's steady-state gain inverted, one lag ahead."""

from __future__ import annotations

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.velocity_model import VelocityModel
from diffdrive_mpc.mpc.slip import Slip


class FeedForward:
    """Commands for the next N ticks from the reference's twists.

    A command shows its effect one lag later (dead time and dynamics), so it answers to the twist that the reference
    has then. The estimated slip is inverted: the command makes up for it.
    """

    def __init__(self, model: VelocityModel, dt: float, steps: int) -> None:
        self.inverse_gain = np.linalg.inv(model.dc_gain)
        # A zero close to the origin can make a lag negative: there is no twist before now to answer to.
        ahead = np.maximum(model.lag, 0.0) / dt
        self.whole = np.floor(ahead).astype(int)
        self.rest = ahead - self.whole
        self._rows = np.arange(steps)[:, None] + self.whole
        self.samples = int(self._rows.max()) + 2
        """Samples of the reference's twist that `commands` needs, from now on."""

    def commands(self, twist: FloatArray, slip: Slip) -> FloatArray:
        """(N, 2) commands for reference twists (samples, 2) under `slip`."""
        now, after = twist[self._rows, [0, 1]], twist[self._rows + 1, [0, 1]]
        wanted = (now + self.rest * (after - now)) / slip.gains - slip.offset
        return np.asarray(wanted @ self.inverse_gain.T)
