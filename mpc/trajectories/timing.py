"""Kinds of timing, and closed-form speed profiles from rest to rest with limited acceleration."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Literal, NamedTuple, get_args

Timing = Literal["stop", "commanded", "smooth"]
"""Kind of speed profile along a path.

stop: exact path within the limits; the robot stops where the curvature jumps. commanded: twists of the file with steps
between them, and a ramp at both ends. smooth: clothoids replace jumps of the curvature; the robot stops only at cusps
and at turns on the spot, and the speed stays within the limits.
"""
TIMINGS: tuple[Timing, ...] = get_args(Timing)


class Phase(NamedTuple):
    """Time interval of constant acceleration along a section of a path."""

    offset: float
    """Progress at the start of the phase, in the unit of the section's length."""
    rate: float
    """Rate of the progress at the start of the phase [unit of length/s]."""
    acceleration: float
    """Constant acceleration of the progress [unit of length/s^2]."""
    duration: float
    """Duration of the phase [s]."""


def rest_to_rest(lengths: Sequence[float], cruises: Sequence[float], acceleration: float) -> list[list[Phase]]:
    """Compute the time-optimal timing of consecutive sections of a path from rest to rest.

    A forward and a backward pass reduce the speeds at the joints according to the acceleration limit. The speed profile
    of each section is then a trapezoid, or a triangle if the section is too short for its cruise speed.

    Parameters
    ----------
    lengths
        Positive length of each section, in any unit.
    cruises
        Positive maximum speed on each section [unit of length/s].
    acceleration
        Positive maximum acceleration and deceleration [unit of length/s^2].

    Returns
    -------
    list of list of Phase
        Phases of each section in order of time; phases of zero duration are omitted.
    """
    joints = [0.0, *(min(pair) for pair in pairwise(cruises)), 0.0]
    for i, length in enumerate(lengths):
        joints[i + 1] = min(joints[i + 1], _reachable(joints[i], length, acceleration))
    for i in reversed(range(len(lengths))):
        joints[i] = min(joints[i], _reachable(joints[i + 1], lengths[i], acceleration))
    return [
        trapezoid(length, cruise, joints[i], joints[i + 1], acceleration)
        for i, (length, cruise) in enumerate(zip(lengths, cruises, strict=True))
    ]


def _reachable(rate: float, length: float, acceleration: float) -> float:
    """Compute the maximum speed after acceleration from the speed `rate` over the distance `length`."""
    return math.sqrt(rate * rate + 2 * acceleration * length)


def trapezoid(length: float, cruise: float, entry: float, leave: float, acceleration: float) -> list[Phase]:
    """Compute the phases of a trapezoidal speed profile from the speed `entry` via `cruise` to the speed `leave`.

    If the section is too short, the speeds at the ends are reduced. `entry` and `leave` must not exceed `cruise`. For
    units see `rest_to_rest`.
    """
    leave = min(leave, _reachable(entry, length, acceleration))
    entry = min(entry, _reachable(leave, length, acceleration))
    # Lengths of the ramps are `rise` and `fall`; the peak of a triangle follows from rise + fall = length.
    peak = min(cruise, math.sqrt(acceleration * length + (entry**2 + leave**2) / 2))
    rise = (peak**2 - entry**2) / (2 * acceleration)
    fall = (peak**2 - leave**2) / (2 * acceleration)
    phases = [
        Phase(0.0, entry, acceleration, (peak - entry) / acceleration),
        Phase(rise, peak, 0.0, (length - rise - fall) / cruise),
        Phase(length - fall, peak, -acceleration, (peak - leave) / acceleration),
    ]
    # Rounding may make the duration of an unnecessary cruise or ramp negative.
    return [phase for phase in phases if phase.duration > 0]
