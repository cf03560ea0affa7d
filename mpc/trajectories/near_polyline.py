"""Spline near the polyline of its waypoints, which interpolates the waypoints and rounds corners only if needed."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from diffdrive_mpc.models.interface import FloatArray

_SAMPLES = (np.arange(16) + 0.5) / 16
_SHARE = 0.97
"""Design deviation of a corner as a share of the maximum [-]; the reserve covers the error of the sampled maximum."""
_LEG = 0.45
"""Maximum share of a leg that each of its two corners uses [-]."""
# Kinds of corners: interpolated waypoint, interpolated waypoint with an additional knot, and rounded corner.
_INTERPOLATED, _KNOTS, _ROUNDED = range(3)


def spline_near(waypoints: FloatArray, max_deviation: float) -> CubicSpline:
    """Return a twice continuously differentiable spline at most `max_deviation` [m] from the polyline of `waypoints`.

    The curve is the natural cubic spline over chord length wherever this spline is near enough. At other corners it
    consists of two pieces of the uniform cubic B-spline with control points at -d, 0 and d along the legs. These pieces
    lie in the convex hull of their control points, have zero curvature at their ends, and pass the corner at a distance
    of d sin(turn / 2) / 3. If an adjacent leg is too short, the waypoint is interpolated, and a knot at the distance d
    on the longer leg reduces the overshoot.

    Parameters
    ----------
    waypoints
        (k, 2) x, y [m]; consecutive waypoints must differ.
    max_deviation
        Maximum distance of the path from the polyline, and of each waypoint from the path [m].
    """
    legs = np.diff(waypoints, axis=0)
    chords = np.hypot(*legs.T)
    along = legs / chords[:, None]
    # Difference of the unit vectors of both legs at a corner; its length is 2 sin(turn / 2).
    bend = np.diff(along, axis=0)
    # The distance d of the docstring, from d sin(turn / 2) / 3 = max_deviation.
    reach = np.divide(6 * _SHARE * max_deviation, np.hypot(*bend.T), out=np.full(len(bend), np.inf), where=bend.any(1))
    room = _LEG * np.minimum(chords[:-1], chords[1:])
    kind = np.full(len(waypoints), _INTERPOLATED)
    # Each iteration changes at least one corner, and a corner changes at most twice, so the loop terminates.
    while True:
        spline = _spline(waypoints, chords, along, kind[1:-1], np.minimum(reach, room), reach)
        is_far = _leg_deviations(spline, waypoints, chords) > max_deviation
        if not is_far.any() or (kind[1:-1] == _ROUNDED).all():
            return spline
        is_affected = np.append(is_far, False) | np.append(False, is_far)
        # If all corners of the far legs are already rounded, corners further away cause the overshoot.
        while not (is_affected[1:-1] & (kind[1:-1] < _ROUNDED)).any():
            is_affected[1:-1] |= is_affected[:-2] | is_affected[2:]
        first = np.where(room < reach / 2, _KNOTS, _ROUNDED)
        kind[1:-1] = np.where(is_affected[1:-1], np.where(kind[1:-1] == _INTERPOLATED, first, _ROUNDED), kind[1:-1])


def deviations(points: FloatArray, legs: NDArray[np.signedinteger], waypoints: FloatArray) -> FloatArray:
    """Compute the distances (n,) [m] of `points` (n, 2) from legs of the polyline; `legs` (n,) are their indices."""
    start, leg = waypoints[legs], (waypoints[1:] - waypoints[:-1])[legs]
    share = np.clip(((points - start) * leg).sum(1) / (leg * leg).sum(1), 0.0, 1.0)
    return np.asarray(np.hypot(*(points - start - share[:, None] * leg).T))


def _spline(
    waypoints: FloatArray,
    chords: FloatArray,
    along: FloatArray,
    kind: NDArray[np.signedinteger],
    inner: FloatArray,
    reach: FloatArray,
) -> CubicSpline:
    """Compute the spline for corners of the kinds `kind` (k - 2,).

    Rounded corners use the length `inner` (k - 2,) [m] of both legs; additional knots are at the distance `reach`
    (k - 2,) [m] from the corner.
    """
    ends = np.concatenate([[0.0], np.cumsum(chords)])
    values, knots, points = waypoints.copy(), [ends], [waypoints]
    is_rounded = kind == _ROUNDED
    # Value of a uniform cubic B-spline at its middle control point: (before + 4 corner + after) / 6.
    values[1:-1][is_rounded] += (np.diff(along, axis=0) * inner[:, None] / 6)[is_rounded]
    points[0] = values
    for side, leg in ((-1, slice(0, -1)), (1, slice(1, None))):
        size = np.where(is_rounded, inner, np.where(reach < _LEG * chords[leg], reach, 0.0))
        is_added = (kind != _INTERPOLATED) & (size > 0.0)
        knots.append((ends[1:-1] + side * size)[is_added])
        points.append((waypoints[1:-1] + side * size[:, None] * along[leg])[is_added])
    u = np.concatenate(knots)
    order = np.argsort(u)
    return CubicSpline(u[order], np.concatenate(points)[order], bc_type="natural")


def _leg_deviations(spline: CubicSpline, waypoints: FloatArray, chords: FloatArray) -> FloatArray:
    """Compute the maximum distance (k - 1,) [m] of the spline from each leg, over samples between the knots."""
    ends = np.concatenate([[0.0], np.cumsum(chords)])
    u = spline.x[:-1, None] + np.diff(spline.x)[:, None] * _SAMPLES
    legs = np.searchsorted(ends, spline.x[:-1], side="right") - 1
    distances = deviations(spline(u.ravel()), np.repeat(legs, _SAMPLES.size), waypoints)
    return np.maximum.reduceat(distances, np.searchsorted(legs, np.arange(len(chords))) * _SAMPLES.size)
