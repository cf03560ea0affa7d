"""Settings of the parameters for other packages: read from `settings.yaml`."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Annotated

from pydantic import Field

from diffdrive_mpc.models.checked_yaml import StrictModel, load_checked
from diffdrive_mpc.models.robot import Positive


class StackSettings(StrictModel):
    """Settings of the step from an estimate to parameters for other packages."""

    first_limit: Annotated[float, Field(gt=0, lt=1)] = Field(description="first guess over the largest command [-]")
    max_half_interval: Positive = Field(description="over the value, beyond which it is not known [-]")
    max_radius_half_interval: Positive = Field(description="the same of the radii, which else keep what is stated [-]")
    min_blocks: int = Field(ge=2, description="of readings, to estimate a noise [-]")
    phase_margin: Positive = Field(lt=60, description="of pure pursuit on a straight path [degrees]")
    controller_frequency: Positive = Field(description="of Nav2's controller server [Hz]")
    delay_widening: Annotated[float, Field(ge=1)] = Field(description="of the intervals of delays [-]")
    slow_speed: Positive = Field(description="speed of the least look-ahead [m/s]")


@cache
def stack_settings() -> StackSettings:
    """Read `settings.yaml`; raises ConfigError on a mistake in it."""
    return load_checked(StackSettings, Path(__file__).with_name("settings.yaml"))
