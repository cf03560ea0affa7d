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
    """When a robot has arrived."""

    distance: AboveZero = Field(description="from the end of the path [m]")
    speed: AboveZero = Field(description="fastest [m/s]")
    give_up: AboveZero = Field(description="after standing so long where nothing changes the run is over [s]")


class ContactRules(StrictModel):
    """Definition of a contact."""

    moving_speed: AboveZero = Field(description="a robot that is slower stands [m/s]")
    gap: AboveZero = Field(description="time without contact after which the next one counts anew [s]")


class Sight(StrictModel):
    """Range and quality of the robot's sight."""

    range: AboveZero = Field(description="how far it sees [m]")
    field_of_view: Annotated[float, Field(gt=0, le=2 * math.pi)] = Field(
        description="angle that it sees, straight ahead in its middle [rad]"
    )
    rays: Annotated[int, Field(ge=8, le=5000)] = Field(description="over the field of view")
    range_sd: NotNegative = Field(description="standard deviation of one ray [m]")
    period: Annotated[float, Field(ge=1e-3, le=10)] = Field(description="time between two looks [s]")
    latency: Annotated[float, Field(ge=0, le=2)] = Field(description="from the instant of a look to its arrival [s]")
    kind: Literal["grid", "shapes"] = Field(
        description="grid: a costmap; shapes: outlines of what has been seen, as from a map"
    )
    resolution: Annotated[float, Field(ge=0.005, le=1)] = Field(description="side of a cell [m]")
    size: Annotated[float, Field(gt=0, le=20)] = Field(description="side of the costmap around the robot [m]")
    flipped: Annotated[float, Field(ge=0, le=0.5)] = Field(description="share of cells that are reported wrongly [-]")
    person_sd: NotNegative = Field(description="standard deviation of x and of y of a person [m]")
    person_acceleration: AboveZero = Field(description="how persons are believed to change their velocity [m/s^2]")
    person_memory: NotNegative = Field(
        description="for so long one who has gone out of view is believed to walk on [s]"
    )


class WorldSettings(StrictModel):
    """Everything in `settings.yaml`."""

    body: BodyOutline
    goal: Goal
    contact: ContactRules
    sight: Sight


@cache
def world_settings() -> WorldSettings:
    """Load the shipped settings; raise ConfigError for a mistake in the file."""
    return load_checked(WorldSettings, Path(__file__).parent / "settings.yaml")
