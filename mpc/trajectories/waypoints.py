"""Trajectories through waypoints, with a smooth path and a speed profile within the limits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated

import numpy as np
from pydantic import Field

from diffdrive_mpc.models.checked_yaml import ConfigError, StrictModel
from diffdrive_mpc.models.two_sided import side_of
from diffdrive_mpc.mpc.trajectories.limits import BeyondLimitError, TrajectoryLimits
from diffdrive_mpc.mpc.trajectories.path_timing import squared_speeds, time_path
from diffdrive_mpc.mpc.trajectories.smooth_path import SmoothPath, smooth_path
from diffdrive_mpc.mpc.trajectories.speed_passport import PassportUse, SpeedCaps
from diffdrive_mpc.mpc.trajectories.spline import SplineTrajectory
from diffdrive_mpc.mpc.trajectories.timing import Timing

# Coordinates above 1000 km are due to a wrong unit, and their powers could overflow.
Coordinate = Annotated[float, Field(ge=-1e6, le=1e6)]

# Yaw acceleration limit that is never active [rad/s^2].
_UNLIMITED = 1e9
MAX_DEVIATION = 0.05
"""Default maximum distance of a path through waypoints from the polyline [m]."""


class WaypointFile(StrictModel):
    """Schema of a trajectory file with waypoints."""

    name: str | None = Field(default=None, description="name in tables and figures; default: name of the file")
    waypoints: list[tuple[Coordinate, Coordinate]] = Field(description="points x, y [m] in order of travel")
    speed: float | None = Field(default=None, gt=0, description="cruise speed [m/s]; default: the speed limit")
    max_deviation: float = Field(
        default=MAX_DEVIATION, gt=0, description="maximum distance of the path from the polyline of the waypoints [m]"
    )
    timing: Timing = Field(default="stop", description="timing of the path")
    speed_passport: PassportUse | None = Field(
        default=None, description="speed passport for timing: smooth, which limits the speed for a tolerance"
    )


def time_waypoints(
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
    """Create a timed trajectory on a smooth path through `waypoints` (x, y [m]).

    The path is a natural cubic spline over chord length. Corners where this spline is further than `max_deviation` [m]
    from the polyline are rounded, see `spline_near`; None disables the rounding. The curvature is continuous. The robot
    drives forwards from rest to rest, as fast as `speed` [m/s] and `limits` permit. With the timing "smooth" the
    lateral acceleration is also limited; with "commanded" the speed is constant except for the ramps at both ends.
    `where` is the source of the waypoints in error messages; `caps` are maximum speeds by curvature.

    Raises
    ------
    models.checked_yaml.ConfigError
        If there are fewer than two waypoints, two consecutive waypoints coincide, the path turns too tightly, `speed`
        exceeds the limit, or `caps` contain no speed for a turn.
    """
    if len(waypoints) < 2:
        raise ConfigError(f"{where}: {len(waypoints)} waypoints; give at least two [x, y]")
    max_speed = side_of(limits.v, 1.0)
    if speed is not None and speed > max_speed:
        raise BeyondLimitError(f"{where}: speed = {speed:g} m/s is beyond the limit of {max_speed:g} m/s; lower it")
    path = smooth_path(np.asarray(waypoints, dtype=float), where, max_deviation=max_deviation)
    cruise = speed or max_speed
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
    return SplineTrajectory.through(name, *time_path(path, square, limits), path.deviation)


def _unlimited_yaw_acceleration(
    path: SmoothPath, speed: float, limits: TrajectoryLimits, where: str
) -> TrajectoryLimits:
    """Remove the yaw acceleration limit from `limits`, so that the speed is constant except for the ramps.

    Raises ConfigError if the yaw rate along the path exceeds its limit.
    """
    worst = int(np.argmax(path.bend))
    if path.bend[worst] * speed > limits.omega:
        x, y = path.points[worst]
        raise BeyondLimitError(
            f"{where}: timing commanded: omega = {path.bend[worst] * speed:.3g} rad/s at x = {x:.3g} m, y = {y:.3g} m "
            f"is beyond the limit of {limits.omega:g} rad/s; lower the speed, or choose another timing"
        )
    return replace(limits, omega_acceleration=_UNLIMITED)
