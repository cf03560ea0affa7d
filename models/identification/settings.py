"""What the report says and when it warns: read from `settings.yaml`."""

from __future__ import annotations

from functools import cache
from pathlib import Path

from pydantic import Field

from diffdrive_mpc.models.checked_yaml import StrictModel, load_checked
from diffdrive_mpc.models.robot import Positive


class WarningSettings(StrictModel):
    """When a model is said not to be trusted."""

    low_fit: float = Field(description="[%]")
    fit_drop: Positive = Field(description="[percentage points]")
    unexplained: Positive = Field(description="[-]")
    lever_arm: Positive = Field(description="[m]")


class ReportSettings(StrictModel):
    """Sizes and thresholds of the report."""

    shares: tuple[Positive, Positive] = Field(description="least and largest share to identify from [-]")
    fewest_readings: int = Field(gt=0, description="[-]")
    window: Positive = Field(description="[s]")
    step_response: Positive = Field(description="[lags]")
    limit_margin: float = Field(ge=1, description="[-]")
    warn: WarningSettings


@cache
def report_settings() -> ReportSettings:
    """Read `settings.yaml`; raises ConfigError on a mistake in it."""
    return load_checked(ReportSettings, Path(__file__).parent / "settings.yaml")
