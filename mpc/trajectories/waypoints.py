"""Trajectories through waypoints: a smooth path, then a speed along it that keeps to the limits."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

import numpy as np
from pydantic import Field

from diffdrive_mpc.models.checked_yaml import ConfigError, StrictModel
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.mpc.trajectories.limits import TrajectoryLimits
from diffdrive_mpc.mpc.trajectories.path_timing import squared_speeds
from diffdrive_mpc.mpc.trajectories.smooth_path import smooth_path
from diffdrive_mpc.mpc.trajectories.spline import SplineTrajectory

# A thousand kilometres: further is a mistake of units, and squares of it would overflow before long.
Coordinate = Annotated[float, Field(ge=-1e6, le=1e6)]


class WaypointFile(StrictModel):
    """Schema of a trajectory file with waypoints."""

    name: str | None = Field(default=None, description="name for tables and figures; default: name of the file")
    waypoints: list[tuple[Coordinate, Coordinate]] = Field(description="points x, y [m] in the order of passing")
    speed: float | None = Field(default=None, gt=0, description="cruise speed [m/s]; default: the speed limit")


def lay_waypoints(
    waypoints: Sequence[tuple[float, float]],
    limits: TrajectoryLimits,
    *,
    name: str,
    speed: float | None = None,
    where: str = "trajectory",
) -> SplineTrajectory:
    """Lay a smooth path through `waypoints` (x, y [m]) and time it, starting and ending at rest.

    The path is a natural cubic spline over chord length, so its curvature is continuous. It is driven forwards, as
    fast as `speed` [m/s] and `limits` allow. `where` names the source of the waypoints in error messages.

    Raises
    ------
    models.checked_yaml.ConfigError
        If there are fewer than two waypoints, two that follow each other coincide, the path turns too tightly, or
        `speed` is beyond the limit.
    """
    if len(waypoints) < 2:
        raise ConfigError(f"{where}: {len(waypoints)} waypoints; give at least two [x, y]")
    if speed is not None and speed > limits.v:
        raise ConfigError(f"{where}: speed = {speed:g} m/s is beyond the limit of {limits.v:g} m/s; lower it")
    path = smooth_path(np.asarray(waypoints, dtype=float), where)
    square = squared_speeds(path.lengths, path.bend, path.bend_change, limits, speed or limits.v)
    v = np.sqrt(square)
    # Constant acceleration on each piece: its duration is its length over the mean of the speeds at its ends.
    times = np.concatenate([[0.0], np.cumsum(2 * path.lengths / (v[:-1] + v[1:]))])
    poses = np.column_stack([path.points, path.heading])
    rates = v[:, None] * np.column_stack([np.cos(path.heading), np.sin(path.heading), path.curvature])
    # Between the nodes the heading is a cubic, whose yaw acceleration may exceed the timed one by a hair.
    slower = np.sqrt(max(1.0, _yaw_acceleration(times, path.heading, rates[:, 2]) / limits.omega_acceleration))
    return SplineTrajectory.through(name, times * slower, poses, rates / slower)


def _yaw_acceleration(times: FloatArray, heading: FloatArray, rate: FloatArray) -> float:
    """Largest |second derivative| [rad/s^2] of the cubic pieces with these values and slopes at `times`."""
    step = np.diff(times)
    mean = np.diff(heading) / step
    first, last = rate[:-1], rate[1:]
    # The second derivative is linear on a piece: its extremes are at the ends.
    ends = np.stack([6 * mean - 4 * first - 2 * last, -6 * mean + 2 * first + 4 * last]) / step
    return float(np.abs(ends).max())
