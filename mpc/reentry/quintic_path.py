"""Vectorised construction of smooth paths from the robot's pose to points on the reference."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from diffdrive_mpc.models.interface import FloatArray

# Lower bound of divisors that are lengths [m].
_MIN_LENGTH = 1e-4


class Paths(NamedTuple):
    """C paths of K - 1 pieces each."""

    points: FloatArray
    """(C, K, 2) coordinates x, y of the nodes [m]."""
    heading: FloatArray
    """(C, K) direction of the tangent [rad], unwrapped along each path; the first value is that of `start`."""
    curvature: FloatArray
    """(C, K) curvature [1/m]."""
    lengths: FloatArray
    """(C, K - 1) length of each piece [m]."""


def quintic_paths(
    start: FloatArray, start_curvature: FloatArray, end: FloatArray, end_curvature: FloatArray, nodes: int
) -> Paths:
    """Build quintic Hermite curves between poses, with given curvature at both ends.

    The parameter q ranges from 0 to 1, and g is the length of the chord. At both ends, the first derivative has the
    given direction and the length g, and the second derivative is the curvature times g^2 along the normal.

    Parameters
    ----------
    start, end
        (C, 3) poses x, y [m] and direction of travel [rad].
    start_curvature, end_curvature
        (C,) curvature at the ends [1/m].
    nodes
        Number K of nodes on each path, evenly spaced in q.
    """
    q = np.linspace(0.0, 1.0, nodes)
    chord = np.maximum(np.hypot(end[:, 0] - start[:, 0], end[:, 1] - start[:, 1]), _MIN_LENGTH)[:, None]
    tangents = [chord * np.column_stack([np.cos(p[:, 2]), np.sin(p[:, 2])]) for p in (start, end)]
    normals = [
        (chord * curvature[:, None]) * np.column_stack([-t[:, 1], t[:, 0]])
        for curvature, t in zip((start_curvature, end_curvature), tangents, strict=True)
    ]
    knots = np.stack([start[:, :2], tangents[0], normals[0], end[:, :2], tangents[1], normals[1]])
    points, first, second = (np.einsum("kb,bcx->ckx", basis, knots) for basis in _quintic_basis(q))
    stretch = np.maximum(np.hypot(first[..., 0], first[..., 1]), _MIN_LENGTH * 1e-2)
    curvature = (first[..., 0] * second[..., 1] - first[..., 1] * second[..., 0]) / stretch**3
    heading = np.unwrap(np.arctan2(first[..., 1], first[..., 0]), axis=1)
    heading += start[:, 2:] - heading[:, :1]
    step = np.diff(points, axis=1)
    # An arc is longer than its chord by this factor, up to an error of fourth order in the angle.
    lengths = np.hypot(step[..., 0], step[..., 1]) * (1.0 + np.diff(heading, axis=1) ** 2 / 24.0)
    return Paths(points, heading, curvature, np.maximum(lengths, _MIN_LENGTH * 1e-2))


def _quintic_basis(q: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Compute (K, 6) values, first and second derivatives of the Hermite basis for (p0, p0', p0'', p1, p1', p1'')."""
    powers = np.array(
        [  # coefficients of q^0 ... q^5, from the six conditions at q = 0 and q = 1
            [1.0, 0.0, 0.0, -10.0, 15.0, -6.0],
            [0.0, 1.0, 0.0, -6.0, 8.0, -3.0],
            [0.0, 0.0, 0.5, -1.5, 1.5, -0.5],
            [0.0, 0.0, 0.0, 10.0, -15.0, 6.0],
            [0.0, 0.0, 0.0, -4.0, 7.0, -3.0],
            [0.0, 0.0, 0.0, 0.5, -1.0, 0.5],
        ]
    )
    order = np.arange(6)
    value = q[:, None] ** order
    first = np.concatenate([np.zeros((q.size, 1)), order[1:] * value[:, :-1]], axis=1)
    second = np.concatenate([np.zeros((q.size, 2)), (order[2:] * order[1:-1]) * value[:, :-2]], axis=1)
    return value @ powers.T, first @ powers.T, second @ powers.T
