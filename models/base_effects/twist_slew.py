"""The base follows a commanded twist only at its own acceleration limits."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from models.checked_yaml import StrictModel
from models.interface import FloatArray


class TwistSlew(StrictModel):
    """Slope limits of the commanded twist inside the base, each channel on its own.

    A controller whose own slew limits are no wider never meets them, and its linear model then holds.
    """

    v: float = Field(gt=0, description="largest slope of v_ref that the base follows [m/s^2]")
    omega: float = Field(gt=0, description="largest slope of omega_ref that the base follows [rad/s^2]")

    def step(self, previous: ArrayLike, command: ArrayLike, dt: float) -> FloatArray:
        """Twist (..., 2) that the base has reached `dt` seconds after `previous` on its way to `command`."""
        before = np.asarray(previous, dtype=float)
        reach = np.array([self.v, self.omega]) * dt
        return np.asarray(before + np.clip(np.asarray(command, dtype=float) - before, -reach, reach))

    def follow(self, commands: ArrayLike, dt: float, start: ArrayLike) -> FloatArray:
        """Twists (K, 2) inside the base after each sample of `dt` [s] under `commands` (K, 2), from `start` (2,)."""
        commands = np.asarray(commands, dtype=float)
        reached = np.empty_like(commands)
        last = np.asarray(start, dtype=float)
        for k, command in enumerate(commands):
            last = reached[k] = self.step(last, command, dt)
        return reached
