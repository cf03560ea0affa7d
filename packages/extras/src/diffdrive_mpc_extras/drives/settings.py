"""Bounds and starts of the search for a drive model, read from `settings.yaml`."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Annotated

from pydantic import Field

from diffdrive_mpc.models.checked_yaml import StrictModel, load_checked
from diffdrive_mpc.models.robot import Positive


class ParameterRange(StrictModel):
    """Where a number is looked for."""

    low: float
    high: float
    size: Positive = Field(description="a usual change of it")


class FitSettings(StrictModel):
    """The search."""

    most_dead_time: Positive = Field(description="[s]")
    most_steps: Annotated[int, Field(ge=1)] = Field(description="of one least-squares search [-]")
    still: tuple[Positive, Positive] = Field(description="speed below which a robot stands [m/s], [rad/s]")
    actuator_lag: Positive = Field(description="of the physical model, not searched [s]")
    friction: Positive = Field(description="viscous, of the physical model, not searched [N m s/rad]")
    bounds: dict[str, ParameterRange]
    starts: tuple[dict[str, float], ...]
    priors: dict[str, float] = Field(description="of numbers that a log need not tell")
    min_gain: Positive = Field(description="rise of the error power that a prior has to cost, or it is kept [-]")


@cache
def fit_settings() -> FitSettings:
    """Read the file; raises ConfigError on a mistake in it."""
    return load_checked(FitSettings, Path(__file__).with_name("settings.yaml"))
