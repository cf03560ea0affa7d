"""Common settings of all worlds: hull, arrival at the goal, and sight."""

from __future__ import annotations

import math
from functools import cache
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from diffdrive_mpc.models.checked_yaml import StrictModel, load_checked

AboveZero = Annotated[float, Field(gt=0, le=1e3)]
NotNegative = Annotated[float, Field(ge=0, le=1e3)]


class BodyOutline(StrictModel):
    """Outline data that the robot's file lacks."""

    tyre_width: NotNegative = Field(description="width of a tyre, whose middle is at half the track [m]")
    height: AboveZero = Field(description="height of hull and obstacles [m]")


class Goal(StrictModel):
    """Conditions of the arrival at the goal, and the end of a blocked run."""

    distance: AboveZero = Field(description="maximum distance from the end of the path at arrival [m]")
    speed: AboveZero = Field(description="maximum speed at arrival [m/s]")
    give_up: AboveZero = Field(description="standstill after which a run in a world without changes ends [s]")


class ContactRules(StrictModel):
    """Definition of a contact."""

    moving_speed: AboveZero = Field(description="speed below which the robot counts as standing [m/s]")
    gap: AboveZero = Field(description="time without contact after which the next contact is a new event [s]")


class Sight(StrictModel):
    """Range and quality of the obstacle sensors: a laser scanner and a detector of persons."""

    range: AboveZero = Field(description="maximum range [m]")
    field_of_view: Annotated[float, Field(gt=0, le=2 * math.pi)] = Field(
        description="field of view, symmetric about the forward direction [rad]"
    )
    rays: Annotated[int, Field(ge=8, le=5000)] = Field(description="number of rays over the field of view")
    range_sd: NotNegative = Field(description="standard deviation of the range of one ray [m]")
    period: Annotated[float, Field(ge=1e-3, le=10)] = Field(description="time between two observations [s]")
    latency: Annotated[float, Field(ge=0, le=2)] = Field(description="delay of an observation [s]")
    kind: Literal["grid", "shapes"] = Field(
        description="grid: a costmap; shapes: outlines of all obstacles that a ray has hit"
    )
    resolution: Annotated[float, Field(ge=0.005, le=1)] = Field(description="side of a cell [m]")
    size: Annotated[float, Field(gt=0, le=20)] = Field(description="side of the costmap around the robot [m]")
    flipped: Annotated[float, Field(ge=0, le=0.5)] = Field(description="share of cells with an inverted state [-]")
    person_sd: NotNegative = Field(description="standard deviation of the measured x and y of a person [m]")
    person_acceleration: AboveZero = Field(description="acceleration noise of the Kalman filter of persons [m/s^2]")
    person_memory: NotNegative = Field(description="time for which a person is predicted after the last detection [s]")


class WorldSettings(StrictModel):
    """Contents of `settings.yaml`."""

    body: BodyOutline
    goal: Goal
    contact: ContactRules
    sight: Sight


@cache
def world_settings() -> WorldSettings:
    """Load the shipped settings; raise ConfigError for a mistake in the file."""
    return load_checked(WorldSettings, Path(__file__).parent / "settings.yaml")
