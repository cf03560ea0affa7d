"""Thresholds of the tracking metrics, read from `metrics.yaml`."""

from __future__ import annotations

from functools import cache
from pathlib import Path

from pydantic import Field

from diffdrive_mpc.models.checked_yaml import StrictModel, load_checked
from diffdrive_mpc.models.robot import Positive


class MetricSettings(StrictModel):
    """Thresholds that turn error series into statistics."""

    band: Positive = Field(description="lateral band [m]")
    moving_speed: Positive = Field(description="least speed at which a course error is taken [m/s]")
    end_error: Positive = Field(description="largest distance from the end of a completed run [m]")
    path_window: Positive = Field(description="arc length searched on both sides of the reference [m]")
    path_spacing: Positive = Field(description="spacing of the path's polyline [m]")
    settled_arc: Positive = Field(description="time of constant twist after which an arc counts as steady [s]")


@cache
def metric_settings() -> MetricSettings:
    """Read the shipped thresholds; raises ConfigError when the file has a mistake."""
    return load_checked(MetricSettings, Path(__file__).parent / "metrics.yaml")
