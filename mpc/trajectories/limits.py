"""The speeds and accelerations that a reference trajectory must respect."""

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
    """A trajectory is faster than its limits allow."""


@dataclass(frozen=True, slots=True)
class TrajectoryLimits:
    """Bounds of the reference twist and of its rate of change.

    The first four are numbers, or limits with two sides, see `models.two_sided`. Timing turns and drives curves within
    the smaller side of yaw limits.

    Attributes
    ----------
    v
        Largest forward speed, either way [m/s].
    omega
        Largest yaw rate, either way [rad/s].
    v_acceleration
        Largest forward acceleration [m/s^2].
    omega_acceleration
        Largest yaw acceleration [rad/s^2].
    lateral_acceleration
        Largest lateral acceleration |v omega|, which smooth timing keeps to [m/s^2]; by default that of the robot of
        the papers.
    min_turn_radius
        Turns are no tighter [m]; 0 allows turning on the spot. Only paths back to a reference use it.
    """

    v: float
    omega: float
    v_acceleration: float
    omega_acceleration: float
    lateral_acceleration: float = load_robot().reference_acceleration.lateral
    min_turn_radius: float = 0.0

    def __post_init__(self) -> None:
        """Check that every bound is positive and finite; raises ValueError."""
        for field in fields(self):
            for value in sides_of(getattr(self, field.name)):
                if not (math.isfinite(value) and (value > 0 or (value == 0 and field.name == "min_turn_radius"))):
                    raise ValueError(f"trajectory limit {field.name} = {value}: must be positive and finite")

    @classmethod
    def of_robot(cls, robot: Robot | None = None) -> TrajectoryLimits:
        """Return speed limits and reference accelerations of `robot`; by default the robot of the papers."""
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
        """Return the speed limits of a controller's configuration, and accelerations within its slew limits.

        For slew limits with two sides a share is reserved for tracking; a single number is used in full.
        """
        usual = cls.of_robot()

        def within(slew: SlewLimit, acceleration: float) -> SlewLimit:
            share = 1.0 if slew.is_symmetric else load_settings().slew_share
            return slew.map(lambda side: min(acceleration, share * side))

        return replace(
            usual,
            v=limits.v,
            omega=limits.omega,
            v_acceleration=within(limits.v_slew, usual.v_acceleration),
            omega_acceleration=within(limits.omega_slew, usual.omega_acceleration),
        )


# How trajectory files are checked and refined.


class TrajectorySettings(StrictModel):
    """Resolutions and tolerances of the readers of trajectory files."""

    pieces_per_row: int = Field(ge=2, description="pieces into which the interval between two timed poses is cut")
    pieces_per_waypoint: int = Field(ge=2, description="pieces into which the path between two waypoints is cut")
    speed_excess: float = Field(ge=0, description="share by which timed poses may exceed a speed limit")
    lateral_speed: float = Field(gt=0, description="sideways speed that timed poses may show [m/s]")
    min_turn_radius: float = Field(gt=0, description="tightest radius of a path through waypoints [m]")
    smoothing: float = Field(gt=0, description="distance from the drawn path that smooth timing may use [m]")
    smooth_piece: float = Field(gt=0, description="length of the pieces into which a smoothed path is cut [m]")
    reach_share: float = Field(gt=0, lt=1, description="share of what a robot reaches that a scaled path asks for")
    slew_share: float = Field(gt=0, lt=1, description="share of its slew, for the same")
    longest_duration: float = Field(gt=0, description="longest trajectory [s]")
    longest_excitation: float = Field(gt=0, description="longest drive that is searched for [s]")
    full_pieces: int = Field(ge=1, description="pieces of a path, above which there are fewer from point to point")
    least_pieces_per_row: int = Field(ge=1, description="between two of very many timed poses")
    least_pieces_per_waypoint: int = Field(ge=1, description="between two of very many waypoints")
    max_pieces: int = Field(ge=1, description="of a path; longer ones are refused")
    most_segments: int = Field(ge=1, description="of a file")
    most_joints: int = Field(ge=1, description="different ones that smooth timing rounds")
    tolerance: float = Field(gt=0, description="distance from the drive without limits that is feasible [m]")
    heading_tolerance: float = Field(gt=0, description="difference of heading that is feasible [rad]")

    def pieces_between(self, points: int, usual: int, least: int, where: str) -> int:
        """Choose the number of pieces between two of `points`: the usual number, or fewer for very many points.

        Raises
        ------
        models.checked_yaml.ConfigError
            If even the `least` would make more than `max_pieces`; the message begins with `where`.
        """
        most = self.max_pieces // least
        if points > most:
            raise ConfigError(f"{where}: {points:,} points, at most {most:,}; leave some out, or split it")
        return min(usual, max(least, self.full_pieces // max(1, points - 1)))

    def check_pieces(self, count: float, where: str, remedy: str) -> None:
        """Raise ConfigError where a path would be cut into more than `max_pieces`, before it is."""
        if not count <= self.max_pieces:
            raise ConfigError(
                f"{where}: it is so long that it is cut into {count:.3g} pieces, at most {self.max_pieces:,}; {remedy}"
            )


@cache
def load_settings() -> TrajectorySettings:
    """Read the settings that ship with the package."""
    return load_checked(TrajectorySettings, Path(__file__).parent / "settings.yaml")
