"""The fastest speeds along many paths at once that keep to limits of speed and acceleration, by two passes."""

from __future__ import annotations

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.mpc.reentry.quintic_path import Paths
from diffdrive_mpc.mpc.trajectories.limits import TrajectoryLimits


def path_speeds(
    paths: Paths, enter: FloatArray, leave: FloatArray, limits: TrajectoryLimits, shares: FloatArray
) -> FloatArray:
    """Speed at the nodes of each path.

    The bounds on each piece are those of `mpc.trajectories.path_timing.squared_speeds`, here for C paths at a time and
    with given speeds at both ends. Where a path is too short or too tight for the wanted speeds at its ends, the
    speeds there come out lower.

    Parameters
    ----------
    paths
        C paths of K nodes.
    enter, leave
        (C,) wanted speed at the first and last node [m/s], not negative.
    limits
        Speed and acceleration limits.
    shares
        (S,) shares of the speed limit: each path is timed at each of them [-].

    Returns
    -------
    FloatArray
        (S, C, K) [m/s].
    """
    k, lengths = np.abs(paths.curvature), paths.lengths
    bend = np.maximum(k[:, 1:], k[:, :-1])
    bend_change = np.abs(np.diff(paths.curvature, axis=1)) / lengths
    with np.errstate(divide="ignore", over="ignore"):
        cap = np.minimum((limits.omega / bend) ** 2, limits.omega_acceleration / bend_change)
    # Nodes first, so that a step of a pass works on neighbours in memory.
    square = np.empty((k.shape[1], shares.size, len(k)))
    square[1:-1] = np.minimum(cap[:, 1:], cap[:, :-1]).T[:, None]
    square[0] = np.minimum(enter**2, cap[:, 0])
    square[-1] = np.minimum(leave**2, cap[:, -1])
    # Slower than where it begins and ends only as far as half the acceleration brings it.
    gone = np.concatenate([np.zeros((len(k), 1)), np.cumsum(lengths, axis=1)], axis=1)
    ramps = np.maximum(
        enter[:, None] ** 2 - limits.v_acceleration * gone,
        leave[:, None] ** 2 - limits.v_acceleration * (gone[:, -1:] - gone),
    )
    cruise = np.maximum(((shares * limits.v) ** 2)[:, None], ramps.T[:, None])
    square = np.minimum(square, np.minimum(cruise, limits.v**2))
    # Rise from b0 to b1: b1 <= b0 + 2 a_max ds, and |dk/ds| b1 + |k| (b1 - b0) / (2 ds) <= alpha_max, solved for b1.
    rise = (2.0 * limits.v_acceleration * lengths).T
    lever = (bend / (2.0 * lengths)).T
    total = np.maximum(bend_change.T + lever, 1e-12)
    most, slope = limits.omega_acceleration / total, lever / total
    for i in range(len(rise)):
        reached = np.minimum(square[i] + rise[i], most[i] + slope[i] * square[i])
        np.minimum(square[i + 1], reached, out=square[i + 1])
    for i in reversed(range(len(rise))):
        reached = np.minimum(square[i + 1] + rise[i], most[i] + slope[i] * square[i + 1])
        np.minimum(square[i], reached, out=square[i])
    return np.asarray(np.sqrt(np.moveaxis(square, 0, -1)))


def travel_times(paths: Paths, speed: FloatArray) -> FloatArray:
    """Time from the first node [s] at speeds (..., C, K), the acceleration being constant on each piece."""
    times = np.zeros_like(speed)
    np.cumsum(2.0 * paths.lengths / np.maximum(speed[..., 1:] + speed[..., :-1], 1e-9), axis=-1, out=times[..., 1:])
    return times
