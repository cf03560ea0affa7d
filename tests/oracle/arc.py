"""One arc of constant twist with its gradient, by hand."""

from __future__ import annotations

import math

import numpy as np

from diffdrive_mpc.models.interface import FloatArray

# sin(x) / x is replaced by a short series below this |x|.
_SHORT_SERIES_LIMIT = 1e-2


def linearised_arc(
    pose: FloatArray, v: float, omega: float, dt: float, side_slip: float = 0.0
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """One arc with its gradient, for a single pose.

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
