"""How trajectory files are checked and refined."""

from __future__ import annotations

from functools import cache
from pathlib import Path

from pydantic import Field

from diffdrive_mpc.models.checked_yaml import StrictModel, load_checked


class TrajectorySettings(StrictModel):
    """Resolutions and tolerances of the readers of trajectory files."""

    pieces_per_row: int = Field(ge=2, description="pieces into which the interval between two timed poses is cut")
    pieces_per_waypoint: int = Field(ge=2, description="pieces into which the path between two waypoints is cut")
    speed_excess: float = Field(ge=0, description="share by which timed poses may exceed a speed limit")
    lateral_speed: float = Field(gt=0, description="sideways speed that timed poses may show [m/s]")
    least_turn_radius: float = Field(gt=0, description="tightest radius of a path through waypoints [m]")
    smoothing: float = Field(gt=0, description="distance from the drawn path that smooth timing may use [m]")
    smooth_piece: float = Field(gt=0, description="length of the pieces into which a smoothed path is cut [m]")
    reach_share: float = Field(gt=0, lt=1, description="share of what a robot reaches that a scaled path asks for")
    slew_share: float = Field(gt=0, lt=1, description="share of its slew, for the same")
    longest_duration: float = Field(gt=0, description="longest trajectory [s]")


@cache
def load_settings() -> TrajectorySettings:
    """Read the settings that ship with the package."""
    return load_checked(TrajectorySettings, Path(__file__).parent / "settings.yaml")
