"""Hard bounds of the command: range and slew, against the last command sent."""

from __future__ import annotations

import numpy as np

from models.interface import FloatArray
from mpc.config import Limits


def slew_step(limits: Limits, dt: float) -> FloatArray:
    """(2,) largest change of the command from one tick to the next [m/s, rad/s]."""
    return np.array([limits.v_slew, limits.omega_slew]) * dt


def command_box(limits: Limits, dt: float, last_command: FloatArray, steps: int, share: float = 1.0) -> FloatArray:
    """Bounds on |command| for the next steps.

    A limit that was tightened below the last command is reached at the slew limit: until then the bound is what the
    slew limit can reach, so the problem always has a solution.

    Returns
    -------
    FloatArray
        (steps, 2) [m/s, rad/s].
    """
    reachable = np.abs(last_command) - slew_step(limits, dt) * np.arange(1, steps + 1)[:, None]
    return np.asarray(np.maximum(reachable, [share * limits.v, share * limits.omega]))


def clip_command(
    command: FloatArray, limits: Limits, dt: float, last_command: FloatArray, share: float = 1.0
) -> FloatArray:
    """The nearest command (2,) inside `share` of range, and slew: a solver meets its bounds only to its tolerance."""
    box = command_box(limits, dt, last_command, 1, share)[0]
    step = slew_step(limits, dt)
    lower = np.maximum(last_command - step, -box)
    upper = np.minimum(last_command + step, box)
    return np.clip(command, lower, upper)
