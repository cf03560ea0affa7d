"""Speed and acceleration limits of reference trajectories, and settings of the trajectory readers."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from functools import cache
from pathlib import Path

from pydantic import Field

from diffdrive_mpc.models.checked_yaml import ConfigError, StrictModel, load_checked
from diffdrive_mpc.models.robot import Robot, load_robot
from diffdrive_mpc.models.two_sided import SlewLimit, sides_of
from diffdrive_mpc.mpc.config.schema import Limits


class BeyondLimitError(ConfigError):
    """Error for a trajectory that exceeds the limits of the robot."""


@dataclass(frozen=True, slots=True)
class TrajectoryLimits:
    """Bounds of the reference twist and of its rate of change.

    The first four bounds are numbers or two-sided limits, see `models.two_sided`. The timing of turns and curves uses
    the lower of the two yaw limits.

    Attributes
    ----------
    v
        Maximum speed, forwards and backwards [m/s].
    omega
        Maximum yaw rate, to both sides [rad/s].
    v_acceleration
        Maximum forward acceleration [m/s^2].
    omega_acceleration
        Maximum yaw acceleration [rad/s^2].
    lateral_acceleration
        Maximum lateral acceleration |v omega| of smooth timing [m/s^2].
    min_turn_radius
        Minimum turn radius of planned paths and paths back to a reference [m]; 0 allows turns on the spot.
    """

    v: float
    omega: float
    v_acceleration: float
    omega_acceleration: float
    lateral_acceleration: float = load_robot().reference_acceleration.lateral
    min_turn_radius: float = 0.0

    def __post_init__(self) -> None:
        """Raise ValueError if a bound is not positive and finite."""
        for field in fields(self):
            for value in sides_of(getattr(self, field.name)):
                if not (math.isfinite(value) and (value > 0 or (value == 0 and field.name == "min_turn_radius"))):
                    raise ValueError(f"trajectory limit {field.name} = {value}: must be positive and finite")

    @classmethod
    def of_robot(cls, robot: Robot | None = None) -> TrajectoryLimits:
        """Create the limits from the speed limits and reference accelerations of `robot`.

        None selects the robot of the papers.
        """
        robot = robot or load_robot()
        return cls(
            v=robot.limits.v,
            omega=robot.limits.omega,
            v_acceleration=robot.reference_acceleration.v,
            omega_acceleration=robot.reference_acceleration.omega,
            lateral_acceleration=robot.reference_acceleration.lateral,
        )

    @classmethod
    def of_controller(cls, limits: Limits) -> TrajectoryLimits:
        """Create the limits from the speed limits of a controller configuration, with accelerations within its slew.

        A share of two-sided slew limits is reserved for tracking; a symmetric limit is used completely.
        """
        default = cls.of_robot()

        def within(slew: SlewLimit, acceleration: float) -> SlewLimit:
            share = 1.0 if slew.is_symmetric else load_settings().slew_share
            return slew.map(lambda side: min(acceleration, share * side))

        return replace(
            default,
            v=limits.v,
            omega=limits.omega,
            v_acceleration=within(limits.v_slew, default.v_acceleration),
            omega_acceleration=within(limits.omega_slew, default.omega_acceleration),
        )


class TrajectorySettings(StrictModel):
    """Resolutions and tolerances of the conversion and checks of trajectories."""

    pieces_per_row: int = Field(ge=2, description="number of pieces between two timed poses")
    pieces_per_waypoint: int = Field(ge=2, description="number of pieces between two waypoints")
    speed_excess: float = Field(ge=0, description="allowed relative excess of a speed limit by timed poses [-]")
    lateral_speed: float = Field(gt=0, description="maximum sideways speed of timed poses [m/s]")
    min_turn_radius: float = Field(gt=0, description="minimum radius of a path through waypoints [m]")
    smoothing: float = Field(gt=0, description="maximum distance of smooth timing from the drawn path [m]")
    smooth_piece: float = Field(gt=0, description="maximum length of the pieces of a smoothed path [m]")
    reach_share: float = Field(gt=0, lt=1, description="speed of a scaled path as a share of the reachable speed [-]")
    slew_share: float = Field(gt=0, lt=1, description="acceleration of a scaled path as a share of the slew [-]")
    max_duration: float = Field(gt=0, description="maximum duration of a trajectory [s]")
    max_speed: float = Field(gt=0, description="maximum speed of a trajectory from arrays [m/s]")
    max_excitation_duration: float = Field(gt=0, description="maximum duration of an excitation drive [s]")
    full_pieces: int = Field(ge=1, description="number of pieces of a path above which each point has fewer pieces")
    min_pieces_per_row: int = Field(ge=1, description="minimum number of pieces between two timed poses")
    min_pieces_per_waypoint: int = Field(ge=1, description="minimum number of pieces between two waypoints")
    max_pieces: int = Field(ge=1, description="maximum number of pieces of a path")
    max_segments: int = Field(ge=1, description="maximum number of segments of a file")
    max_joints: int = Field(ge=1, description="maximum number of different joints for smooth timing")
    tolerance: float = Field(gt=0, description="maximum deviation of a drive within the limits [m]")
    heading_tolerance: float = Field(gt=0, description="maximum heading error of a drive within the limits [rad]")

    def pieces_between(self, points: int, default: int, minimum: int, where: str) -> int:
        """Return the number of pieces between two of `points` points: `default`, or fewer for many points.

        Raises
        ------
        models.checked_yaml.ConfigError
            If even `minimum` pieces per point exceed `max_pieces`; the message starts with `where`.
        """
        max_points = self.max_pieces // minimum
        if points > max_points:
            raise ConfigError(f"{where}: {points:,} points, at most {max_points:,}; remove points, or split the path")
        return min(default, max(minimum, self.full_pieces // max(1, points - 1)))

    def check_pieces(self, count: float, where: str, remedy: str) -> None:
        """Raise ConfigError if a path requires more than `max_pieces`; call it before the path is computed."""
        if not count <= self.max_pieces:
            raise ConfigError(f"{where}: its length requires {count:.3g} pieces, at most {self.max_pieces:,}; {remedy}")


@cache
def load_settings() -> TrajectorySettings:
    """Load the settings from `settings.yaml` of this package."""
    return load_checked(TrajectorySettings, Path(__file__).parent / "settings.yaml")
