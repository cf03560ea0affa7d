"""Time along a path: the maximum speed within the speed and acceleration limits, by two passes."""

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
        Highest speed wanted, on all or on each (m,) of the pieces [m/s].
    lateral
        Whether the lateral acceleration |k| v^2 is limited too.
    enter
        Speed at the start [m/s]; less where the path ahead needs it.
    sense
        1 forwards, -1 backwards.

    Returns
    -------
    FloatArray
        (m + 1,) v^2 [m^2/s^2].
    """
    with np.errstate(divide="ignore", over="ignore"):
        cap = np.minimum(
            np.minimum(cruise, side_of(limits.v, sense)) ** 2,
            np.minimum((limits.omega / bend) ** 2, limits.omega_acceleration / bend_change),
        )
        if lateral:
            cap = np.minimum(cap, limits.lateral_acceleration / bend)
    # A node belongs to two pieces; the path ends at rest.
    square = np.concatenate([[min(enter**2, cap[0])], np.minimum(cap[:-1], cap[1:]), [0.0]])
    # Rise from b0 to b1: b1 <= b0 + 2 a_max ds, and |dk/ds| b1 + |k| (b1 - b0) / (2 ds) <= alpha_max, solved for b1.
    # As plain numbers, which a loop takes ten times as fast as those of an array.
    rises = [(2 * acceleration * lengths).tolist() for acceleration in sides_of(limits.v_acceleration)]
    lever = (bend / (2 * lengths)).tolist()
    total = (bend_change + bend / (2 * lengths)).tolist()
    reached: list[float] = square.tolist()
    most = limits.omega_acceleration

    def passed(pieces: Sequence[int], ahead: int) -> None:
        """Lower the speed `ahead` of each piece to what can be reached from its other end."""
        behind = 1 - ahead
        rise = rises[behind]
        for i in pieces:
            start = reached[i + behind]
            free, room, share = start + rise[i], most + lever[i] * start, total[i]
            reachable = free if share * free <= room else room / share
            reached[i + ahead] = min(reached[i + ahead], reachable)

    passed(range(lengths.size), 1)
    passed(range(lengths.size - 1, -1, -1), 0)
    return np.array(reached)


def timed(
    path: SmoothPath, square: FloatArray, limits: TrajectoryLimits, sense: int = 1
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Compute instants (m + 1,) [s] from 0, poses (m + 1, 3) and their time derivatives at the ends of the pieces.

    `square` are the squared speeds there [m^2/s^2], `sense` is 1 forwards and -1 backwards.
    """
    v = np.sqrt(square)
    # Constant acceleration on each piece: its duration is its length over the mean of the speeds at its ends.
    times = np.concatenate([[0.0], np.cumsum(2 * path.lengths / (v[:-1] + v[1:]))])
    poses = np.column_stack([path.points, path.heading])
    along = sense * np.column_stack([np.cos(path.heading), np.sin(path.heading)])
    rates = v[:, None] * np.column_stack([along, path.curvature])
    # Between the nodes the heading is a cubic, whose yaw acceleration may slightly exceed the timed one.
    slower = np.sqrt(max(1.0, _yaw_acceleration(times, path.heading, rates[:, 2]) / limits.omega_acceleration))
    return times * slower, poses, rates / slower


def _yaw_acceleration(times: FloatArray, heading: FloatArray, rate: FloatArray) -> float:
    """Return the maximum |second derivative| [rad/s^2] of the cubic pieces with these values and slopes at `times`."""
    step = np.diff(times)
    mean = np.diff(heading) / step
    first, last = rate[:-1], rate[1:]
    # The second derivative is linear on a piece: its extremes are at the ends.
    ends = np.stack([6 * mean - 4 * first - 2 * last, -6 * mean + 2 * first + 4 * last]) / step
    return float(np.abs(ends).max())
