"""Arcs of constant twists, and derivatives by complex steps; functions accept real and complex numbers."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from diffdrive_mpc.models.interface import FloatArray

# Complex steps have no cancellation, so the square of the step can be negligible compared with 1.
_STEP = 1e-30
_SMALL = 1e-2


def wrap(angle: FloatArray) -> FloatArray:
    """Wrap `angle` [rad] to [-pi, pi)."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


def sinc(x: FloatArray) -> FloatArray:
    """Compute sin(x) / x, by a series near zero, where the quotient and its derivative lose digits."""
    small = np.abs(x) < _SMALL
    square = x * x
    series = 1 - square / 6 + square**2 / 120 - square**3 / 5040
    safe = np.where(small, 1.0, x)
    return np.where(small, series, np.sin(safe) / safe)


def arc(
    theta: FloatArray, v: FloatArray, omega: FloatArray, dt: float, sideways: FloatArray | float = 0.0
) -> tuple[FloatArray, ...]:
    """Compute the displacement dx, dy [m], dtheta [rad] over `dt` from the heading `theta`.

    The body moves along the chord of its arc, v dt sinc(omega dt / 2) in the direction of its mean heading, and to the
    left of that direction by the ratio of `sideways` [m/s] to v.
    """
    mean, chord = theta + 0.5 * omega * dt, dt * sinc(0.5 * omega * dt)
    along, left = v * chord, sideways * chord
    return along * np.cos(mean) - left * np.sin(mean), along * np.sin(mean) + left * np.cos(mean), omega * dt


def sideways(v: FloatArray, omega: FloatArray, side_slip: FloatArray | float, ahead: FloatArray | float) -> FloatArray:
    """Compute the lateral speed of the origin [m/s] (left) about a point `ahead` [m] of it, which slips outward."""
    outward = side_slip * v * omega
    return -omega * ahead - outward


def slid(
    theta: FloatArray, omega: FloatArray, dt: float, slide: FloatArray | tuple[float, float]
) -> tuple[FloatArray, FloatArray]:
    """Compute the displacement dx, dy [m] over `dt` of a robot that slides by `slide` [m/rad], x and y, per radian.

    The component of `slide` along the mean heading acts by half; at low yaw rates the slide is small.
    """
    mean, chord = theta + 0.5 * omega * dt, dt * sinc(0.5 * omega * dt)
    angle = chord * (np.sqrt(omega**2 + 0.05**2) - 0.05)
    left_x, left_y = -np.sin(mean), np.cos(mean)
    across = left_x * slide[0] + left_y * slide[1]
    return 0.5 * angle * (slide[0] + left_x * across), 0.5 * angle * (slide[1] + left_y * across)


def linearise(function: Callable[[FloatArray], FloatArray], point: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return value (m,) and derivative (m, n) of `function` at `point` (n,).

    `function` maps points (n, k), in columns, to values (m, k).

    f(x + i h) = f(x) + i h f'(x) + O(h^2): the imaginary part is the derivative, without a difference (Squire, Trapp,
    SIAM Review 40(1), 1998).
    """
    values = function(point[:, None] + 1j * _STEP * np.eye(len(point)))
    return np.real(values[:, 0]), np.imag(values) / _STEP


def jacobian(function: Callable[[FloatArray], FloatArray], point: FloatArray) -> FloatArray:
    """Return the derivative (m, n) of `function` at `point` (n,)."""
    return linearise(function, point)[1]


# sin(x) / x is replaced by a short series below this |x|.
_SHORT_SERIES_LIMIT = 1e-2


def linearised_arc(
    pose: FloatArray, v: float, omega: float, dt: float, side_slip: float = 0.0
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Compute one arc with its gradient, for a single pose.

    Returns
    -------
    tuple
        The pose (3,) after `dt`, its gradient (3, 3) with respect to the pose before, and its gradient (3, 3) with
        respect to (v, omega, side_slip).
    """
    x, y, theta = pose
    half = 0.5 * omega * dt
    if abs(half) < _SHORT_SERIES_LIMIT:
        square = half * half
        sinc = 1 - square / 6 * (1 - square / 20 * (1 - square / 42))
        slope = -half / 3 * (1 - square / 10 * (1 - square / 28))
    else:
        sinc = math.sin(half) / half
        slope = (math.cos(half) - sinc) / half
    c, s, chord, crab = math.cos(theta + half), math.sin(theta + half), v * dt * sinc, side_slip * omega
    # The body moves by (chord, -chord crab) along and across the mean heading.
    along, across = c + crab * s, s - crab * c
    turn, stretch = 0.5 * dt * chord, 0.5 * dt * v * dt * slope
    end = np.array([x + chord * along, y + chord * across, theta + omega * dt])
    by_pose = np.array([[1.0, 0.0, -chord * across], [0.0, 1.0, chord * along], [0.0, 0.0, 1.0]])
    by_twist = np.array(
        [
            [dt * sinc * along, stretch * along - turn * across + chord * side_slip * s, chord * omega * s],
            [dt * sinc * across, stretch * across + turn * along - chord * side_slip * c, -chord * omega * c],
            [0.0, dt, 0.0],
        ]
    )
    return end, by_pose, by_twist
