"""How a planner's path is read and smoothed."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Annotated

from pydantic import Field

from diffdrive_mpc.models.checked_yaml import StrictModel, load_checked

Positive = Annotated[float, Field(gt=0)]


class PlannedSettings(StrictModel):
    """Resolutions and thresholds; distances in m, angles in rad."""

    coincident: Positive = Field(description="closer poses are at one place [m]")
    spacing: Positive = Field(description="of the points that are smoothed [m]")
    smoothing_length: Positive = Field(description="shorter waves of a path are smoothed away [m]")
    bendable: Positive = Field(description="a heading no further off at an end is reached by bending the path [rad]")
    sideways: Positive = Field(description="|cos| between heading and travel from which a pose says the direction [-]")
    least_run: Positive = Field(description="a change of direction that is shorter is noise [m]")
    hairpin: Positive = Field(description="a path that turns so far is turned back on the spot [rad]")
    hairpin_length: Positive = Field(description="over which that is looked at, to either side [m]")
    join: Positive = Field(description="over which a path leads from a robot beside it onto it [m]")
    turns_per_metre: Positive = Field(description="a path that turns back more often is no planner's [1/m]")
    turns_allowed: Annotated[int, Field(ge=0)] = Field(description="so many turns more are allowed [-]")
    longest: Positive = Field(description="a longer path is a mistake of units [m]")


@cache
def load_settings() -> PlannedSettings:
    """Read the settings that ship with the package."""
    return load_checked(PlannedSettings, Path(__file__).parent / "settings.yaml")
