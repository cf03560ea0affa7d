"""Pose kinematics: the exact arc of a body that moves with constant twist.

Source: Guffanti et al., Sensors 2025, 25(11), 3553 (odometry equations), with the sign of dy restored, written
with the sinc of the half angle so that value and gradient are smooth through omega = 0. Side-slip adds a lateral
speed in proportion to v omega.
"""

from __future__ import annotations

import math
from functools import cache

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from diffdrive_mpc.models.interface import FloatArray

# sin(x)/x is replaced by its series below this |x|: the first term left out is below 1e-17 relative there.
_SERIES_LIMIT = 1e-2


def _sinc(x: FloatArray) -> FloatArray:
    """sin(x) / x, smooth through zero."""
    return np.asarray(np.sinc(x / np.pi))


def integrate_pose(
    pose: ArrayLike, v: ArrayLike, omega: ArrayLike, dt: float, side_slip: ArrayLike = 0.0
) -> FloatArray:
    """Advance a pose along the exact arc of a constant twist.

    Parameters
    ----------
    pose
        (..., 3) x [m], y [m], theta [rad].
    v, omega
        (...) forward speed [m/s] and yaw rate [rad/s], constant over `dt`. They broadcast with `pose[..., 0]`.
    dt
        Duration [s]; may be negative, which goes back along the same arc.
    side_slip
        (...) lateral speed over -v omega [s]: the body drifts outward in a turn with side_slip v omega.

    Returns
    -------
    FloatArray
        (..., 3) the pose after `dt`. theta is not wrapped.
    """
    pose = np.asarray(pose, dtype=float)
    v, omega = np.asarray(v, dtype=float), np.asarray(omega, dtype=float)
    half = 0.5 * omega * dt
    chord = v * dt * _sinc(half)
    crab = np.asarray(side_slip, dtype=float) * omega
    theta = pose[..., 2]
    c, s = np.cos(theta + half), np.sin(theta + half)
    return np.stack(
        np.broadcast_arrays(
            pose[..., 0] + chord * (c + crab * s), pose[..., 1] + chord * (s - crab * c), theta + omega * dt
        ),
        axis=-1,
    )


def linearised_arc(
    pose: FloatArray, v: float, omega: float, dt: float, side_slip: float = 0.0
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """One arc with its gradient, for a single pose: quicker than `integrate_pose`, and the same numbers.

    Returns
    -------
    tuple
        The pose (3,) after `dt`, its gradient (3, 3) with respect to the pose before, and its gradient (3, 3) with
        respect to (v, omega, side_slip).
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
    c, s, chord, crab = math.cos(theta + half), math.sin(theta + half), v * dt * sinc, side_slip * omega
    # Along and across the mean heading the body moves by (chord, -chord crab).
    along, across = c + crab * s, s - crab * c
    turn, stretch = 0.5 * dt * chord, 0.5 * dt * v * dt * slope
    after = np.array([x + chord * along, y + chord * across, theta + omega * dt])
    by_pose = np.array([[1.0, 0.0, -chord * across], [0.0, 1.0, chord * along], [0.0, 0.0, 1.0]])
    by_twist = np.array(
        [
            [dt * sinc * along, stretch * along - turn * across + chord * side_slip * s, chord * omega * s],
            [dt * sinc * across, stretch * across + turn * along - chord * side_slip * c, -chord * omega * c],
            [0.0, dt, 0.0],
        ]
    )
    return after, by_pose, by_twist


@cache
def arc_function() -> ca.Function:
    """CasADi function of one arc, differentiable through omega = 0.

    Maps `(pose (3), v, omega, dt, side_slip)` to `pose_next (3)`; a side_slip that is left out counts as zero.
    """
    pose, v, omega, dt = ca.SX.sym("pose", 3), ca.SX.sym("v"), ca.SX.sym("omega"), ca.SX.sym("dt")
    side_slip = ca.SX.sym("side_slip")
    half = omega * dt / 2
    square = half * half
    small = ca.fabs(half) < _SERIES_LIMIT
    series = 1 - square / 6 * (1 - square / 20 * (1 - square / 42))
    # The unused branch is evaluated too: keep it finite, or its derivative poisons the result with NaN.
    safe = ca.if_else(small, 1.0, half)
    chord = v * dt * ca.if_else(small, series, ca.sin(safe) / safe)
    c, s, crab = ca.cos(pose[2] + half), ca.sin(pose[2] + half), side_slip * omega
    after = ca.vertcat(pose[0] + chord * (c + crab * s), pose[1] + chord * (s - crab * c), pose[2] + omega * dt)
    names = ["pose", "v", "omega", "dt", "side_slip"]
    return ca.Function("arc", [pose, v, omega, dt, side_slip], [after], names, ["pose_next"])


def wrap_angle(angle: ArrayLike) -> FloatArray:
    """Wrap angles [rad] into [-pi, pi)."""
    return np.asarray((np.asarray(angle, dtype=float) + np.pi) % (2 * np.pi) - np.pi)
