"""Refuse a reference that the limits cannot follow, before the robot moves."""

from __future__ import annotations

import numpy as np

from diffdrive_mpc.models.interface import Reference
from diffdrive_mpc.mpc.config.schema import Limits

# A spline through timed poses may ring a little over its limit.
_SPEED_EXCESS = 1.01
_MOST_SAMPLES = 100_000


def check_speeds(reference: Reference, limits: Limits, dt: float) -> None:
    """Compare the speeds of `reference`, sampled every `dt` [s], with the hard limits of the command.

    Raises
    ------
    ValueError
        With one line that names reference, time, value and limit.
    """
    times = np.linspace(0.0, reference.duration, min(int(reference.duration / dt) + 2, _MOST_SAMPLES))
    twist = np.abs(reference.sample(times).twist)
    for row, (name, limit) in enumerate((("v", limits.v), ("omega", limits.omega))):
        worst = int(np.argmax(twist[:, row]))
        value = float(twist[worst, row])
        if not value <= limit * _SPEED_EXCESS:
            raise ValueError(
                f"reference '{reference.name}': {name} = {value:.3g} at {times[worst]:.2f} s is more than "
                f"limits.{name} = {limit:g}; slow the reference down or raise the limit"
            )
