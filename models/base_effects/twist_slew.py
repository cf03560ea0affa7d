"""The base follows a commanded twist only at its own acceleration limits."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from diffdrive_mpc.models.checked_yaml import StrictModel
from diffdrive_mpc.models.interface import FloatArray


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
        columns = [
            _ramps(column, limit * dt, float(first))
            for column, limit, first in zip(
                commands.T, (self.v, self.omega), np.asarray(start, dtype=float), strict=True
            )
        ]
        return np.stack(columns, axis=-1)


def _ramps(commands: FloatArray, reach: float, start: float) -> FloatArray:
    """(K,) what follows `commands` (K,) by at most `reach` a sample: one ramp for each run of equal commands."""
    if not len(commands):
        return np.empty(0)
    first = np.flatnonzero(np.concatenate([[True], np.diff(commands) != 0]))
    counts = np.diff(np.append(first, len(commands)))
    missing = np.empty(len(first))
    last = start
    # Plain numbers: a log may well change its command at every sample.
    for run, (target, count) in enumerate(zip(commands[first].tolist(), counts.tolist(), strict=True)):
        gap = last - target
        missing[run] = gap
        left = abs(gap) - reach * count
        last = target + (left if gap > 0 else -left) if left > 0 else target
    passed = np.arange(len(commands)) - np.repeat(first, counts) + 1
    gap = np.repeat(missing, counts)
    return np.asarray(commands + np.sign(gap) * np.maximum(np.abs(gap) - reach * passed, 0.0))
