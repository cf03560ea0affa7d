"""Pose kinematics: the exact arc of a body that moves with constant twist.

Source: Guffanti et al., Sensors 2025, 25(11), 3553 (odometry equations), with the sign of dy restored, written
with the sinc of the half angle so that value and gradient are smooth through omega = 0.
"""

from __future__ import annotations

import math
from functools import cache

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from models.interface import FloatArray

# sin(x)/x is replaced by its series below this |x|: the first term left out is below 1e-17 relative there.
_SERIES_LIMIT = 1e-2


def _sinc(x: FloatArray) -> FloatArray:
    """sin(x) / x, smooth through zero."""
    return np.asarray(np.sinc(x / np.pi))


def integrate_pose(pose: ArrayLike, v: ArrayLike, omega: ArrayLike, dt: float) -> FloatArray:
    """Advance a pose along the exact arc of a constant twist.

    Parameters
    ----------
    pose
        (..., 3) x [m], y [m], theta [rad].
    v, omega
        (...) forward speed [m/s] and yaw rate [rad/s], constant over `dt`. They broadcast with `pose[..., 0]`.
    dt
        Duration [s]; may be negative, which goes back along the same arc.

    Returns
    -------
    FloatArray
        (..., 3) the pose after `dt`. theta is not wrapped.
    """
    pose = np.asarray(pose, dtype=float)
    v, omega = np.asarray(v, dtype=float), np.asarray(omega, dtype=float)
    half = 0.5 * omega * dt
    chord = v * dt * _sinc(half)
    theta = pose[..., 2]
    direction = theta + half
    return np.stack(
        np.broadcast_arrays(
            pose[..., 0] + chord * np.cos(direction), pose[..., 1] + chord * np.sin(direction), theta + omega * dt
        ),
        axis=-1,
    )


def linearised_arc(pose: FloatArray, v: float, omega: float, dt: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """One arc with its gradient, for a single pose: quicker than `integrate_pose`, and the same numbers.

    Returns
    -------
    tuple
        The pose (3,) after `dt`, its gradient (3, 3) with respect to the pose before, and its gradient (3, 2) with
        respect to (v, omega).
    """
    x, y, theta = pose
    half = 0.5 * omega * dt
    if abs(half) < _SERIES_LIMIT:
        square = half * half
        sinc = 1 - square / 6 * (1 - square / 20 * (1 - square / 42))
        slope = -half / 3 * (1 - square / 10 * (1 - square / 28))
    else:
        sinc = math.sin(half) / half
        slope = (math.cos(half) - sinc) / half
    c, s, chord = math.cos(theta + half), math.sin(theta + half), v * dt * sinc
    turn, stretch = 0.5 * dt * chord, 0.5 * dt * v * dt * slope
    after = np.array([x + chord * c, y + chord * s, theta + omega * dt])
    by_pose = np.array([[1.0, 0.0, -chord * s], [0.0, 1.0, chord * c], [0.0, 0.0, 1.0]])
    by_twist = np.array([[dt * sinc * c, stretch * c - turn * s], [dt * sinc * s, stretch * s + turn * c], [0.0, dt]])
    return after, by_pose, by_twist


@cache
def arc_function() -> ca.Function:
    """CasADi function of one arc: `(pose (3), v, omega, dt) -> pose (3)`, differentiable through omega = 0."""
    pose, v, omega, dt = ca.SX.sym("pose", 3), ca.SX.sym("v"), ca.SX.sym("omega"), ca.SX.sym("dt")
    half = omega * dt / 2
    square = half * half
    small = ca.fabs(half) < _SERIES_LIMIT
    series = 1 - square / 6 * (1 - square / 20 * (1 - square / 42))
    # The unused branch is evaluated too: keep it finite, or its derivative poisons the result with NaN.
    safe = ca.if_else(small, 1.0, half)
    chord = v * dt * ca.if_else(small, series, ca.sin(safe) / safe)
    direction = pose[2] + half
    after = ca.vertcat(pose[0] + chord * ca.cos(direction), pose[1] + chord * ca.sin(direction), pose[2] + omega * dt)
    return ca.Function("arc", [pose, v, omega, dt], [after], ["pose", "v", "omega", "dt"], ["pose_next"])


def wrap_angle(angle: ArrayLike) -> FloatArray:
    """Wrap angles [rad] into [-pi, pi)."""
    return np.asarray((np.asarray(angle, dtype=float) + np.pi) % (2 * np.pi) - np.pi)
