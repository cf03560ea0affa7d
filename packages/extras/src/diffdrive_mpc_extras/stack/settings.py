"""Settings of the estimate for other packages, read from `settings.yaml`."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Annotated

from pydantic import Field

from diffdrive_mpc.models.checked_yaml import StrictModel, load_checked
from diffdrive_mpc.models.robot import Positive


class StackSettings(StrictModel):
    """Settings of the estimate of parameters for other packages."""

    first_limit: Annotated[float, Field(gt=0, lt=1)] = Field(
        description="first guess of a limit, as a ratio to the maximum command [-]"
    )
    max_half_interval: Positive = Field(
        description="maximum half interval of a known quantity, relative to its value [-]"
    )
    max_radius_half_interval: Positive = Field(
        description="maximum half interval of a known radius, relative to its value [-]"
    )
    min_blocks: int = Field(ge=2, description="minimum number of blocks of readings for a noise estimate [-]")
    phase_margin: Positive = Field(lt=60, description="phase margin of pure pursuit on a straight path [degrees]")
    controller_frequency: Positive = Field(description="frequency of Nav2's controller server [Hz]")
    delay_widening: Annotated[float, Field(ge=1)] = Field(
        description="factor on the width of the delays' intervals [-]"
    )
    slow_speed: Positive = Field(description="speed of the minimum look-ahead [m/s]")


@cache
def stack_settings() -> StackSettings:
    """Read `settings.yaml`; raises ConfigError if it is invalid."""
    return load_checked(StackSettings, Path(__file__).with_name("settings.yaml"))
