"""Paths of continuous, piecewise linear curvature: clothoids replace the jumps of curvature between arcs.

At a joint of two arcs, three clothoids replace a section of both arcs, whose length on each arc is called reach.
Position, heading and curvature are continuous at both ends, so the rest of the path does not change. Three clothoids
are the minimum for such a joint: Bertolazzi and Frego, "On the G2 Hermite interpolation problem with clothoids", J.
Comput. Appl. Math. 341 (2018). In this implementation the ratios of their lengths are fixed, and the unknowns are two
curvatures and the total length.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq, root

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.pose import integrate_pose

# Share of the middle clothoid in the length of a joint [-]; a larger share reduces the slope of the curvature, a
# smaller share reduces the overshoot.
_MIDDLE = 0.4
_LENGTH_SHARES = np.array([(1 - _MIDDLE) / 2, _MIDDLE, (1 - _MIDDLE) / 2])
# Maximum turn of each arc within a joint [rad], for which `_fit` converges.
_MAX_TURN = math.pi / 2
# Reach below which a joint is omitted [m].
_MIN_REACH = 1e-9
# Samples of a joint for its maximum distance from the arcs, as shares of its length.
_SAMPLES = np.linspace(0.0, 1.0, 41)
# `_fit` integrates a whole clothoid of a joint in one step, for which 16 nodes are exact up to rounding.
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(16)


class Clothoid(NamedTuple):
    """Section of a path whose curvature is linear in arc length."""

    length: float
    """Length [m], positive."""
    first: float
    """Curvature at the start [1/m]: turn to the left [rad] per length of path, for both directions of travel."""
    last: float
    """Curvature at the end [1/m]."""


class Joint(NamedTuple):
    """Transition that replaces a jump of curvature."""

    start_curvature: float
    """Curvature of the arc before the joint [1/m]."""
    end_curvature: float
    """Curvature of the arc after the joint [1/m]."""
    reach: float
    """Length by which both arcs are shortened [m]."""
    parts: tuple[Clothoid, ...]
    """Clothoids in order of travel; empty if the curvature does not jump or an arc is too short."""


def sample_clothoids(parts: Sequence[Clothoid], arc_length: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Compute poses and curvatures of a path of clothoids that starts at the origin and is driven forwards.

    Parameters
    ----------
    parts
        Clothoids in order of travel.
    arc_length
        (n,) arc lengths [m], increasing from 0.

    Returns
    -------
    FloatArray, FloatArray
        (n, 3) x, y [m], theta [rad]; (n,) curvature [1/m].
    """
    lengths, first, last = np.array(parts).T
    ends = np.cumsum(lengths)
    headings = np.concatenate([[0.0], np.cumsum(lengths * (first + last) / 2)])

    def heading_at(s: FloatArray) -> tuple[FloatArray, FloatArray]:
        piece = np.minimum(np.searchsorted(ends, s, side="left"), len(ends) - 1)
        offset = s - (ends - lengths)[piece]
        slope = ((last - first) / lengths)[piece]
        return headings[piece] + offset * (first[piece] + slope * offset / 2), first[piece] + slope * offset

    heading, curvature = heading_at(arc_length)
    step = np.diff(arc_length)[:, None]
    inside, _ = heading_at(arc_length[:-1, None] + step * (_NODES + 1) / 2)
    points = np.stack([np.cos(inside) @ _WEIGHTS, np.sin(inside) @ _WEIGHTS], axis=1) * step / 2
    return np.column_stack([np.concatenate([np.zeros((1, 2)), np.cumsum(points, axis=0)]), heading]), curvature


@lru_cache(maxsize=1024)
def joint(start_curvature: float, end_curvature: float, max_reach: float, distance: float) -> Joint:
    """Design the clothoids between two arcs of the curvatures `start_curvature` and `end_curvature` [1/m].

    The reach is the maximum that is at most `max_reach` [m] and for which the joint deviates by at most `distance` [m]
    from the arcs.
    """
    max_reach = min(max_reach, _MAX_TURN / max(abs(start_curvature), abs(end_curvature), _MIN_REACH))
    if start_curvature == end_curvature or max_reach < _MIN_REACH:
        return Joint(start_curvature, end_curvature, 0.0, ())

    def build(reach: float) -> Joint:
        return Joint(start_curvature, end_curvature, reach, _fit(start_curvature, end_curvature, reach))

    def excess(reach: float) -> float:
        candidate = build(reach)
        length = sum(part.length for part in candidate.parts)
        return float(distances(sample_clothoids(candidate.parts, _SAMPLES * length)[0], candidate).max()) - distance

    if excess(max_reach) <= 0:
        return build(max_reach)
    # The target distance is slightly below the limit, so that the result is within the limit despite rounding.
    return build(max_reach * brentq(lambda share: excess(share * max_reach) + 0.001 * distance, 1e-6, 1.0, xtol=1e-6))


def _fit(start_curvature: float, end_curvature: float, reach: float) -> tuple[Clothoid, ...]:
    """Compute the clothoids from `reach` [m] before the meeting point of two arcs to `reach` after this point."""
    target = integrate_pose(integrate_pose(np.zeros(3), 1.0, start_curvature, reach), 1.0, end_curvature, reach)
    overshoot = 0.1 * (end_curvature - start_curvature)

    def parts(unknown: FloatArray) -> tuple[Clothoid, ...]:
        knots = (start_curvature, unknown[0] / reach, unknown[1] / reach, end_curvature)
        lengths = _LENGTH_SHARES * unknown[2] * reach
        return tuple(Clothoid(*row) for row in zip(lengths.tolist(), knots[:-1], knots[1:], strict=True))

    def gap(unknown: FloatArray) -> FloatArray:
        clothoids = parts(unknown)
        poses, _ = sample_clothoids(clothoids, np.append(0.0, np.cumsum([clothoid.length for clothoid in clothoids])))
        # The division by the reach makes positions and heading comparable for any reach.
        return np.asarray((poses[-1] - target) / (reach, reach, 1.0))

    guess = np.array([(start_curvature - overshoot) * reach, (end_curvature + overshoot) * reach, 2.0])
    solution = root(gap, guess, tol=1e-13)
    assert np.abs(gap(solution.x)).max() < 1e-9, "arcs that turn by at most a quarter can be joined"
    return parts(solution.x)


def distances(poses: FloatArray, transition: Joint) -> FloatArray:
    """Compute the distances (n,) [m] of poses (n, 3), in the frame of the start of a joint, from the replaced arcs.

    Each arc of a joint turns by less than half a turn. The closest point is therefore on the first arc for poses behind
    the meeting point of the arcs, measured along their common tangent, and on the second arc for poses ahead of it.
    """
    x, y, theta = integrate_pose(np.zeros(3), 1.0, transition.start_curvature, transition.reach)
    cos, sin = math.cos(theta), math.sin(theta)
    ahead = cos * (poses[:, 0] - x) + sin * (poses[:, 1] - y)
    left = cos * (poses[:, 1] - y) - sin * (poses[:, 0] - x)
    curvature = np.where(ahead < 0, transition.start_curvature, transition.end_curvature)
    # Distance to a circle through the origin, in a form that is also valid for straight lines.
    offset = 2 * left - curvature * (ahead**2 + left**2)
    return np.asarray(np.abs(offset) / (1 + np.hypot(curvature * ahead, 1 - curvature * left)))
