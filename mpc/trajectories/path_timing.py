"""Timing of a path with the maximum speed within speed and acceleration limits, by a forward and a backward pass."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.two_sided import side_of, sides_of
from diffdrive_mpc.mpc.trajectories.limits import TrajectoryLimits
from diffdrive_mpc.mpc.trajectories.smooth_path import SmoothPath


def squared_speeds(
    lengths: FloatArray,
    bend: FloatArray,
    bend_change: FloatArray,
    limits: TrajectoryLimits,
    cruise: float | FloatArray,
    *,
    lateral: bool = False,
    enter: float = 0.0,
    sense: int = 1,
) -> FloatArray:
    """Compute the squared speed at the ends of the pieces of a path that ends at rest.

    The acceleration a is constant on each piece, so v^2 is linear in arc length. With curvature k, the yaw acceleration
    is dk/ds v^2 + k a. Its bound |dk/ds| v^2 + |k| |a| decreases if the speed at the faster end of a piece is reduced,
    so one forward and one backward pass suffice. The bound is conservative if the two terms have opposite signs.

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
        Desired maximum speed [m/s], a number or (m,) values for the pieces.
    lateral
        True to limit the lateral acceleration |k| v^2 as well.
    enter
        Desired speed at the start [m/s]; reduced if the path ahead requires it.
    sense
        Direction of travel: 1 forwards, -1 backwards.

    Returns
    -------
    FloatArray
        (m + 1,) squared speed v^2 [m^2/s^2].
    """
    with np.errstate(divide="ignore", over="ignore"):
        cap = np.minimum(
            np.minimum(cruise, side_of(limits.v, sense)) ** 2,
            np.minimum((limits.omega / bend) ** 2, limits.omega_acceleration / bend_change),
        )
        if lateral:
            cap = np.minimum(cap, limits.lateral_acceleration / bend)
    # The bounds of both adjacent pieces apply to a node, and the speed at the end is zero.
    square = np.concatenate([[min(enter**2, cap[0])], np.minimum(cap[:-1], cap[1:]), [0.0]])
    # Increase of v^2 from b0 to b1 on a piece: b1 <= b0 + 2 a_max ds, and |dk/ds| b1 + |k| (b1 - b0) / (2 ds) <=
    # alpha_max, solved for b1. In a loop, lists of floats are ten times faster than array elements.
    rises = [(2 * acceleration * lengths).tolist() for acceleration in sides_of(limits.v_acceleration)]
    lever = (bend / (2 * lengths)).tolist()
    total = (bend_change + bend / (2 * lengths)).tolist()
    speeds: list[float] = square.tolist()
    omega_acceleration = limits.omega_acceleration

    def run_pass(pieces: Sequence[int], ahead: int) -> None:
        """Reduce the speed at the end `ahead` (0 or 1) of each piece to the maximum reachable from the other end."""
        behind = 1 - ahead
        rise = rises[behind]
        for i in pieces:
            start = speeds[i + behind]
            free, bound, factor = start + rise[i], omega_acceleration + lever[i] * start, total[i]
            reachable = free if factor * free <= bound else bound / factor
            speeds[i + ahead] = min(speeds[i + ahead], reachable)

    # The forward pass limits acceleration, the backward pass braking; the docstring explains why one of each suffices.
    run_pass(range(lengths.size), 1)
    run_pass(range(lengths.size - 1, -1, -1), 0)
    return np.array(speeds)


def time_path(
    path: SmoothPath, square: FloatArray, limits: TrajectoryLimits, sense: int = 1
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Compute times (m + 1,) [s] from 0, poses (m + 1, 3) and their time derivatives at the ends of the pieces.

    `square` (m + 1,) are the squared speeds at the ends [m^2/s^2]; `sense` is 1 forwards and -1 backwards.
    """
    v = np.sqrt(square)
    # With constant acceleration, the duration of a piece is its length divided by the mean of the speeds at its ends.
    times = np.concatenate([[0.0], np.cumsum(2 * path.lengths / (v[:-1] + v[1:]))])
    poses = np.column_stack([path.points, path.heading])
    along = sense * np.column_stack([np.cos(path.heading), np.sin(path.heading)])
    rates = v[:, None] * np.column_stack([along, path.curvature])
    # Between the nodes the heading is cubic, so the yaw acceleration may slightly exceed the limit; a longer duration
    # corrects the excess.
    time_factor = np.sqrt(max(1.0, _yaw_acceleration(times, path.heading, rates[:, 2]) / limits.omega_acceleration))
    return times * time_factor, poses, rates / time_factor


def _yaw_acceleration(times: FloatArray, heading: FloatArray, rate: FloatArray) -> float:
    """Return the maximum absolute second derivative [rad/s^2] of the cubic with given values and slopes at `times`."""
    step = np.diff(times)
    mean = np.diff(heading) / step
    first, last = rate[:-1], rate[1:]
    # The second derivative is linear on each piece, so its extrema are at the ends.
    ends = np.stack([6 * mean - 4 * first - 2 * last, -6 * mean + 2 * first + 4 * last]) / step
    return float(np.abs(ends).max())
