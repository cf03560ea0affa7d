"""Limits of the command as peers keep them: range and slew, as the core keeps them for our controller."""

from __future__ import annotations

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.mpc.config.schema import Limits


def slew_step(limits: Limits, dt: float) -> FloatArray:
    """(2,) largest change of the command from one tick to the next [m/s, rad/s]."""
    return np.array([limits.v_slew, limits.omega_slew]) * dt


def nearest_command(command: FloatArray, limits: Limits, dt: float, last: FloatArray) -> FloatArray:
    """The nearest command (2,) inside the range, and inside slew of `last` (2,)."""
    most, step = np.array([limits.v, limits.omega]), slew_step(limits, dt)
    return np.asarray(np.clip(np.clip(command, -most, most), last - step, last + step))
