"""Smooth paths of continuous curvature through waypoints, divided into short pieces."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.mpc.trajectories.limits import load_settings
from diffdrive_mpc.mpc.trajectories.near_polyline import deviations, spline_near

_MIN_CHORD = 1e-9
"""Minimum distance between consecutive waypoints [m]."""
_REVERSAL = -0.96
"""Cosine of a turn below which no deviation rounds it: 164 degrees."""
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(5)


@dataclass(frozen=True, eq=False)
class SmoothPath:
    """Path of m short pieces, with geometry at the ends of the pieces and bounds over each piece."""

    points: FloatArray
    """(m + 1, 2) x, y [m]."""
    heading: FloatArray
    """(m + 1,) direction of the tangent, or heading of a robot that drives backwards [rad, unwrapped]."""
    curvature: FloatArray
    """(m + 1,) curvature [1/m]."""
    lengths: FloatArray
    """(m,) length of each piece [m]."""
    bend: FloatArray
    """(m,) maximum absolute curvature on each piece [1/m]."""
    bend_change: FloatArray
    """(m,) maximum absolute derivative of the curvature by arc length on each piece [1/m^2]."""
    deviation: FloatArray | None = None
    """(m + 1,) distance from the polyline of the waypoints [m]; None if `max_deviation` was not given."""


def smooth_path(
    waypoints: FloatArray,
    where: str,
    pieces: int | None = None,
    ends: tuple[float | None, float | None] = (None, None),
    max_deviation: float | None = None,
) -> SmoothPath:
    """Fit a natural cubic spline over chord length through `waypoints` (k, 2) [m], k >= 2, and divide it into pieces.

    `where` is the source of the waypoints in error messages. `pieces` is the number of pieces between two waypoints;
    None selects the number of the settings. `ends` are the directions of the path [rad] at the start and at the end;
    None leaves the direction free. With `max_deviation` [m], `spline_near` computes the spline, and `ends` is ignored.

    Raises
    ------
    models.checked_yaml.ConfigError
        If two consecutive waypoints coincide, there are too many waypoints, or the path turns too tightly.
    """
    settings = load_settings()
    if pieces is None:
        minimum = settings.min_pieces_per_waypoint
        pieces = settings.pieces_between(len(waypoints), settings.pieces_per_waypoint, minimum, where)
    chords = np.hypot(*np.diff(waypoints, axis=0).T)
    if chords.min() < _MIN_CHORD:
        index = int(np.argmin(chords))
        raise ConfigError(f"{where}: waypoints.{index} and waypoints.{index + 1} coincide; remove one")
    along = np.concatenate([[0.0], np.cumsum(chords)])
    if max_deviation is None:
        bounds = tuple((2, np.zeros(2)) if end is None else (1, np.array([np.cos(end), np.sin(end)])) for end in ends)
        spline = CubicSpline(along, waypoints, bc_type=bounds)
    else:
        spline = spline_near(waypoints, max_deviation)
        # Keep the total number of pieces despite the additional knots of this spline.
        pieces = max(1, pieces * chords.size // (spline.x.size - 1))
    u = np.append((spline.x[:-1, None] + np.diff(spline.x)[:, None] * np.arange(pieces) / pieces).ravel(), spline.x[-1])
    inside = u[:-1, None] + np.diff(u)[:, None] * (_NODES + 1) / 2

    tangent = spline(u, 1)
    heading = np.unwrap(np.arctan2(tangent[:, 1], tangent[:, 0]))
    curvature, _, _ = bending(spline, u)
    bend, bend_change, stretch = (np.abs(values) for values in bending(spline, inside))
    lengths = np.diff(u) / 2 * (stretch @ _WEIGHTS)
    # The integration nodes exclude the ends of a piece, where the curvature may have its maximum. The derivative of the
    # curvature jumps at the knots, so it is evaluated only inside the pieces.
    bend = np.maximum(bend.max(axis=1), np.maximum(np.abs(curvature[:-1]), np.abs(curvature[1:])))
    # At a cusp the heading jumps, although the curvature may be zero on both sides.
    mean_curvature = np.abs(np.diff(heading)) / lengths
    index = int(np.argmax(mean_curvature))
    if mean_curvature[index] * settings.min_turn_radius > 1:
        leg = int(np.searchsorted(along[1:-1], u[index], side="right"))
        alternative = ""
        legs = np.diff(waypoints, axis=0)
        turns = (legs[:-1] * legs[1:]).sum(axis=1) / (chords[:-1] * chords[1:])
        if (turns[max(leg - 1, 0) : leg + 1] < _REVERSAL).any():
            alternative = ", or split the path there, because it turns back"
        elif max_deviation is not None:
            # Without rounding, the path is that of an unlimited deviation.
            with suppress(ConfigError):
                smooth_path(waypoints, where)
                alternative = f", or raise max_deviation = {max_deviation:g}"
        raise ConfigError(
            f"{where}: the path turns with a radius below {settings.min_turn_radius:g} m between waypoints."
            f"{leg} and waypoints.{leg + 1}; add or move waypoints to round the turn{alternative}"
        )
    points = spline(u)
    deviation = None
    if max_deviation is not None:
        deviation = deviations(points, np.searchsorted(along[1:-1], u, side="right"), waypoints)
    return SmoothPath(points, heading, curvature, lengths, bend, bend_change.max(axis=1), deviation)


def bending(spline: CubicSpline, u: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Compute curvature [1/m], its derivative by arc length [1/m^2], and the tangent length at parameters `u`."""
    first, second, third = (spline(u, order) for order in (1, 2, 3))
    stretch = np.hypot(first[..., 0], first[..., 1])
    with np.errstate(divide="ignore", invalid="ignore"):
        curvature = _cross(first, second) / stretch**3
        change = (_cross(first, third) / stretch**3 - 3 * curvature * (first * second).sum(-1) / stretch**2) / stretch
    return curvature, change, stretch


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Compute the z component of the cross product of vectors in the plane (..., 2)."""
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])
