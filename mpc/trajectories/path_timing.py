"""The fastest speed along a given path that keeps to the speed and acceleration limits, by two passes."""

from __future__ import annotations

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.mpc.trajectories.limits import TrajectoryLimits


def squared_speeds(
    lengths: FloatArray, bend: FloatArray, bend_change: FloatArray, limits: TrajectoryLimits, cruise: float
) -> FloatArray:
    """Squared speed at the ends of the pieces of a path, at rest at both ends of the path.

    On each piece the acceleration a is constant, so v^2 is linear in arc length. With curvature k the yaw acceleration
    is dk/ds v^2 + k a. It is bounded by |dk/ds| v^2 + |k| |a|, which only falls when the faster end of a piece is
    slowed down, so one pass forwards and one backwards leave every piece inside the limits. This is stricter than
    needed where the two terms have opposite signs.

    Parameters
    ----------
    lengths
        (m,) length of each piece [m].
    bend
        (m,) bound of |k| on each piece [1/m].
    bend_change
        (m,) bound of |dk/ds| on each piece [1/m^2].
    limits
        Speed and acceleration limits.
    cruise
        Highest speed wanted [m/s].

    Returns
    -------
    FloatArray
        (m + 1,) v^2 [m^2/s^2].
    """
    with np.errstate(divide="ignore", over="ignore"):
        cap = np.minimum(
            min(cruise, limits.v) ** 2,
            np.minimum((limits.omega / bend) ** 2, limits.omega_acceleration / bend_change),
        )
    # A node belongs to two pieces; the path starts and ends at rest.
    square = np.concatenate([[0.0], np.minimum(cap[:-1], cap[1:]), [0.0]])
    # Rise from b0 to b1: b1 <= b0 + 2 a_max ds, and |dk/ds| b1 + |k| (b1 - b0) / (2 ds) <= alpha_max, solved for b1.
    rise = 2 * limits.v_acceleration * lengths
    lever = bend / (2 * lengths)
    total = bend_change + lever

    def reachable(piece: int, start: float) -> float:
        free = start + rise[piece]
        room = limits.omega_acceleration + lever[piece] * start
        return float(free if total[piece] * free <= room else room / total[piece])

    for i in range(lengths.size):
        square[i + 1] = min(square[i + 1], reachable(i, square[i]))
    for i in reversed(range(lengths.size)):
        square[i] = min(square[i], reachable(i, square[i + 1]))
    return square
