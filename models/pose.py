"""Pose kinematics: the exact arc of a body that moves with constant twist.

Source: Guffanti et al., Sensors 2025, 25(11), 3553 (odometry equations), with the sign of dy corrected. The formula
uses the sinc of the half angle, so that value and gradient are smooth at omega = 0, and adds the lateral speed of a
body with side-slip.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from diffdrive_mpc.models.errors import checked_call
from diffdrive_mpc.models.interface import FloatArray

# Below this |x| the series of sin(x)/x is used: its first omitted term is below 1e-18. Above it the derivative of
# sin(x)/x loses at most one digit, also in single precision.
_SERIES_LIMIT, _SERIES_TERMS = 0.2, 6


class _Functions(NamedTuple):
    """Functions of NumPy or CasADi in the formula of the arc."""

    sin: Callable[[Any], Any]
    cos: Callable[[Any], Any]
    sinc: Callable[[Any], Any]


def _numeric_sinc(x: Any) -> Any:  # noqa: ANN401 - numbers or arrays
    if not isinstance(x, float):
        return np.sinc(x / np.pi)
    # For a single number, these operations of `np.sinc` are ten times faster.
    product = np.pi * (x / np.pi) or np.finfo(float).eps
    return np.sin(product) / product


def _symbolic_sinc(x: ca.SX) -> ca.SX:
    """Return the CasADi expression of sin(x) / x, with smooth derivatives at zero."""
    square = x * x
    small = ca.fabs(x) < _SERIES_LIMIT
    series = ca.SX(0)
    for k in reversed(range(_SERIES_TERMS)):
        series = 1 / math.factorial(2 * k + 1) - square * series
    # CasADi evaluates both branches, so the unused branch must be finite, or its derivative would be NaN.
    safe = ca.if_else(small, 1.0, x)
    return ca.SX(ca.if_else(small, series, ca.sin(safe) / safe))


_NUMERIC = _Functions(np.sin, np.cos, _numeric_sinc)
_SYMBOLIC = _Functions(ca.sin, ca.cos, _symbolic_sinc)


def _displacement(  # numbers, arrays or symbols
    functions: _Functions,
    theta: Any,  # noqa: ANN401
    v: Any,  # noqa: ANN401
    omega: Any,  # noqa: ANN401
    dt: Any,  # noqa: ANN401
    lateral: Any,  # noqa: ANN401
) -> tuple[Any, Any, Any]:
    """Compute the displacement (dx, dy, dtheta) of the exact arc, for numbers or symbols.

    The body moves by the chord v dt sinc(omega dt / 2) along its mean heading theta + omega dt / 2, and by
    lateral dt sinc(omega dt / 2) to the left of the mean heading.
    """
    half = 0.5 * omega * dt
    chord = dt * functions.sinc(half)
    c, s = functions.cos(theta + half), functions.sin(theta + half)
    return chord * (v * c - lateral * s), chord * (v * s + lateral * c), omega * dt


def arc_displacement(theta: ca.SX, v: ca.SX, omega: ca.SX, dt: ca.SX, lateral: ca.SX) -> ca.SX:
    """Return the CasADi expression (3) of the displacement dx, dy [m], dtheta [rad] over one arc from `theta`.

    It is differentiable at omega = 0; the symbols are scalars in the units of `integrate_pose`.
    """
    return ca.SX(ca.vertcat(*_displacement(_SYMBOLIC, theta, v, omega, dt, lateral)))


@checked_call()
def integrate_pose(
    pose: ArrayLike, v: ArrayLike, omega: ArrayLike, dt: ArrayLike, side_slip: ArrayLike = 0.0
) -> FloatArray:
    """Advance a pose along the exact arc of a constant twist.

    Parameters
    ----------
    pose
        (..., 3) x [m], y [m], theta [rad].
    v, omega
        (...) forward speed [m/s] and yaw rate [rad/s], constant over `dt`. They broadcast with `pose[..., 0]`.
    dt
        (...) duration [s]; a negative duration moves back along the arc.
    side_slip
        (...) lateral speed over -v omega [s]: in a turn the body slips outward with speed side_slip v omega.

    Returns
    -------
    FloatArray
        (..., 3) the pose after `dt`. theta is not wrapped.

    Raises
    ------
    ValueError
        If the last axis of `pose` does not have length 3.
    """
    pose = np.asarray(pose, dtype=float)
    if pose.shape[-1:] != (3,):
        raise ValueError(f"pose: shape {pose.shape}; give x, y and theta in the last axis")
    v, omega, dt, side_slip = (np.asarray(argument, dtype=float) for argument in (v, omega, dt, side_slip))
    dx, dy, dtheta = _displacement(_NUMERIC, pose[..., 2], v, omega, dt, -side_slip * v * omega)
    moved = pose[..., 0] + dx, pose[..., 1] + dy, pose[..., 2] + dtheta
    if all(isinstance(value, float) for value in moved):
        return np.array(moved)
    return np.stack(np.broadcast_arrays(*moved), axis=-1)


def wrap_angle(angle: ArrayLike) -> FloatArray:
    """Wrap angles [rad] into [-pi, pi)."""
    return np.asarray((np.asarray(angle, dtype=float) + np.pi) % (2 * np.pi) - np.pi)


def ahead_and_left(gap: FloatArray, heading: ArrayLike) -> tuple[Any, Any]:
    """Rotate the first two components of `gap` (..., 2 or more) [m] into a frame with `heading` (...) [rad]."""
    c, s = np.cos(heading), np.sin(heading)
    return c * gap[..., 0] + s * gap[..., 1], c * gap[..., 1] - s * gap[..., 0]
