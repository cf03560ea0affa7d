"""Ways of timing, and rest-to-rest speed profiles under an acceleration limit, in closed form."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Literal, NamedTuple, get_args

Timing = Literal["stop", "commanded", "smooth"]
"""Speed profile of a drawn path.

stop: the path exactly, within the limits; the robot stops where the curvature jumps. commanded: twists as they are
drawn, which step while the robot drives; a ramp at the start and one at the end. smooth: jumps of curvature rounded by
clothoids, within the limits; the robot stops at cusps and turns on the spot only.
"""
TIMINGS: tuple[Timing, ...] = get_args(Timing)


class Phase(NamedTuple):
    """A stretch of time with constant acceleration along one stretch of path."""

    offset: float
    """Distance from the start of the stretch of path at the start of the phase."""
    rate: float
    """Speed at the start of the phase."""
    acceleration: float
    """Acceleration throughout the phase."""
    duration: float
    """Duration of the phase [s]."""


def rest_to_rest(lengths: Sequence[float], cruises: Sequence[float], acceleration: float) -> list[list[Phase]]:
    """Time consecutive stretches of path, starting and ending at rest, as fast as the bounds allow.

    A forward and a backward pass reduce the speeds at the joints to those that the acceleration permits; each stretch
    then gets a trapezoid, or a triangle if it is too short for its cruise speed.

    Parameters
    ----------
    lengths
        Length of each stretch, positive, in any one unit.
    cruises
        Highest speed on each stretch, positive; that unit per second.
    acceleration
        Largest acceleration and deceleration, positive; that unit per second squared.

    Returns
    -------
    list of list of Phase
        The phases of each stretch, in order; none has zero duration.
    """
    joints = [0.0, *(min(pair) for pair in pairwise(cruises)), 0.0]
    for i, length in enumerate(lengths):
        joints[i + 1] = min(joints[i + 1], _reachable(joints[i], length, acceleration))
    for i in reversed(range(len(lengths))):
        joints[i] = min(joints[i], _reachable(joints[i + 1], lengths[i], acceleration))
    return [
        between(length, cruise, joints[i], joints[i + 1], acceleration)
        for i, (length, cruise) in enumerate(zip(lengths, cruises, strict=True))
    ]


def _reachable(rate: float, length: float, acceleration: float) -> float:
    """Compute the speed reached from `rate` over `length`."""
    return math.sqrt(rate * rate + 2 * acceleration * length)


def between(length: float, cruise: float, entry: float, leave: float, acceleration: float) -> list[Phase]:
    """Plan the phases from `entry` over `cruise` to `leave`; both are reduced if the length is too short.

    Both are at most `cruise`; units and phases are those of `rest_to_rest`.
    """
    leave = min(leave, _reachable(entry, length, acceleration))
    entry = min(entry, _reachable(leave, length, acceleration))
    peak = min(cruise, math.sqrt(acceleration * length + (entry**2 + leave**2) / 2))
    rise = (peak**2 - entry**2) / (2 * acceleration)
    fall = (peak**2 - leave**2) / (2 * acceleration)
    phases = [
        Phase(0.0, entry, acceleration, (peak - entry) / acceleration),
        Phase(rise, peak, 0.0, (length - rise - fall) / cruise),
        Phase(length - fall, peak, -acceleration, (peak - leave) / acceleration),
    ]
    # Rounding leaves a triangle's cruise, or an unneeded ramp, a hair off zero.
    return [phase for phase in phases if phase.duration > 0]
