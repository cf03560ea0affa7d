"""Settings of the planner, described in `settings.yaml`."""

from __future__ import annotations

from functools import cache
from pathlib import Path

from pydantic import Field

from diffdrive_mpc.models.checked_yaml import StrictModel, load_checked
from diffdrive_mpc.models.robot import NotNegative, Positive, Share


class SearchSettings(StrictModel):
    """Settings of the search for the shape."""

    yaw_rates: int = Field(ge=2, le=200)
    concentration: Positive
    step: Positive
    step_angle: Positive
    cell: Positive
    headings: int = Field(ge=4, le=720)
    batch: int = Field(ge=1, le=1000)
    most_states: int = Field(ge=1)
    eager: float = Field(ge=1.0)
    gap: NotNegative
    shots: int = Field(ge=1, le=200)
    map_cell: Positive
    map_room: Positive


class PolishSettings(StrictModel):
    """Settings of the smoothing optimisation."""

    interval: Positive
    most_nodes: int = Field(ge=20)
    ramp_intervals: int = Field(ge=2)
    iterations: int = Field(ge=1)
    rounds: int = Field(ge=1)
    sag: NotNegative
    radius_margin: Share
    smoothness: NotNegative


class ReferenceMotion(StrictModel):
    """Motion limits of the reference, in addition to speed and minimum radius."""

    acceleration: Positive = Field(description="acceleration of the command [m/s^2]")
    yaw_acceleration: Positive = Field(description="yaw acceleration of the command [rad/s^2]")
    yaw_rate: Positive = Field(description="maximum commanded yaw rate, which limits the speed on sharp arcs [rad/s]")
    top_speed: Positive = Field(description="maximum speed of a request [m/s]")
    margin: NotNegative = Field(description="margin between robot and obstacles [m]")
    longest_detour: Positive = Field(description="maximum ratio of the shortest path to the straight distance [-]")


class PlanSettings(StrictModel):
    """Settings of the planner."""

    search: SearchSettings
    polish: PolishSettings
    motion: ReferenceMotion


@cache
def load_plan_settings(path: str | Path | None = None) -> PlanSettings:
    """Read the settings, by default the shipped ones; raises ConfigError if the file is invalid."""
    return load_checked(PlanSettings, path or Path(__file__).parent / "settings.yaml")
