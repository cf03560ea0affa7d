"""Trajectories through waypoints: a smooth path, then a speed profile within the limits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated

import numpy as np
from pydantic import Field

from diffdrive_mpc.models.checked_yaml import ConfigError, StrictModel
from diffdrive_mpc.models.two_sided import side_of
from diffdrive_mpc.mpc.trajectories.limits import BeyondLimitError, TrajectoryLimits
from diffdrive_mpc.mpc.trajectories.path_timing import squared_speeds, timed
from diffdrive_mpc.mpc.trajectories.smooth_path import SmoothPath, smooth_path
from diffdrive_mpc.mpc.trajectories.speed_passport import PassportUse, SpeedCaps
from diffdrive_mpc.mpc.trajectories.spline import SplineTrajectory
from diffdrive_mpc.mpc.trajectories.timing import Timing

# A thousand kilometres: further is a mistake of units, and squares of it would overflow before long.
Coordinate = Annotated[float, Field(ge=-1e6, le=1e6)]

# rad/s^2, no robot turns so.
_UNLIMITED = 1e9
MAX_DEVIATION = 0.05
"""Distance from the polyline that a path through waypoints may have by default [m]."""


class WaypointFile(StrictModel):
    """Schema of a trajectory file with waypoints."""

    name: str | None = Field(default=None, description="name for tables and figures; default: name of the file")
    waypoints: list[tuple[Coordinate, Coordinate]] = Field(description="points x, y [m] in the order of passing")
    speed: float | None = Field(default=None, gt=0, description="cruise speed [m/s]; default: the speed limit")
    max_deviation: float = Field(
        default=MAX_DEVIATION, gt=0, description="largest distance of the path from the polyline of the waypoints [m]"
    )
    timing: Timing = Field(default="stop", description="how speed is laid over the path")
    speed_passport: PassportUse | None = Field(
        default=None, description="timing: smooth is no faster than this passport allows for a tolerance"
    )


def lay_waypoints(
    waypoints: Sequence[tuple[float, float]],
    limits: TrajectoryLimits,
    *,
    name: str,
    speed: float | None = None,
    where: str = "trajectory",
    timing: Timing = "stop",
    caps: SpeedCaps | None = None,
    max_deviation: float | None = MAX_DEVIATION,
) -> SplineTrajectory:
    """Lay a smooth path through `waypoints` (x, y [m]) and time it.

    The path is a natural cubic spline over chord length where that is at most `max_deviation` [m] from the polyline,
    and rounds the corners elsewhere, see `spline_near`; None: the spline everywhere. Its curvature is continuous. It is
    driven forwards, from rest to rest and as fast as `speed` [m/s] and `limits` allow; with `timing` "smooth" the
    lateral acceleration is limited too. With "commanded" the speed is constant but for the ramps at both ends. `where`
    names the source of the waypoints in error messages; `caps` are greatest speeds by curvature.

    Raises
    ------
    models.checked_yaml.ConfigError
        If there are fewer than two waypoints, two that follow each other coincide, the path turns too tightly, or
        `speed` is beyond the limit, or `caps` know no speed for a turn.
    """
    if len(waypoints) < 2:
        raise ConfigError(f"{where}: {len(waypoints)} waypoints; give at least two [x, y]")
    fastest = side_of(limits.v, 1.0)
    if speed is not None and speed > fastest:
        raise BeyondLimitError(f"{where}: speed = {speed:g} m/s is beyond the limit of {fastest:g} m/s; lower it")
    path = smooth_path(np.asarray(waypoints, dtype=float), where, max_deviation=max_deviation)
    cruise = speed or fastest
    if timing == "commanded":
        limits = _unlimited_yaw_acceleration(path, cruise, limits, where)
    square = squared_speeds(
        path.lengths,
        path.bend,
        path.bend_change,
        limits,
        np.minimum(cruise, caps.speeds_of(path.bend)) if caps else cruise,
        lateral=timing == "smooth",
    )
    return SplineTrajectory.through(name, *timed(path, square, limits), path.deviation)


def _unlimited_yaw_acceleration(
    path: SmoothPath, speed: float, limits: TrajectoryLimits, where: str
) -> TrajectoryLimits:
    """Return limits with which only the ramps at both ends are slower than `speed` [m/s]; omega follows the path.

    Raises ConfigError where omega would be beyond its limit.
    """
    worst = int(np.argmax(path.bend))
    if path.bend[worst] * speed > limits.omega:
        x, y = path.points[worst]
        raise BeyondLimitError(
            f"{where}: timing commanded: omega = {path.bend[worst] * speed:.3g} rad/s at x = {x:.3g} m, y = {y:.3g} m "
            f"is beyond the limit of {limits.omega:g} rad/s; lower the speed, or take another timing"
        )
    return replace(limits, omega_acceleration=_UNLIMITED)
