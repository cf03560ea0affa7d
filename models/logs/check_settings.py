"""Where the checks of a log draw their lines."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Annotated

from pydantic import Field

from diffdrive_mpc.models.checked_yaml import StrictModel, load_checked

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Share = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]


class CheckSettings(StrictModel):
    """Thresholds; the reasons stand in `check_settings.yaml`."""

    gap_time: Positive = Field(description="a longer pause ends a stretch [s]")
    gap_periods: Positive = Field(description="a longer pause ends a stretch [sample times]")
    clock_jump: Positive = Field(description="a pause longer than this is another clock [s]")
    grid_tolerance: Share = Field(description="a stamp this close to a grid point belongs to it [sample times]")
    fewest_samples: int = Field(ge=2, description="of a stretch")
    jitter: Positive = Field(description="95th percentile of a step's deviation [sample times]")
    clock_offset: Positive = Field(description="between the stamps of two sources [s]")
    clock_spread: Positive = Field(description="of stamps against receive times [s]")
    held_share: Share = Field(description="share of repeated readings while the robot moves")
    stuck_time: Positive = Field(description="a reading that stays the same [s]")
    stuck_command: Share = Field(description="of the largest command; the robot should move")
    significant_change: Share = Field(description="of the largest command")
    fewest_changes: int = Field(ge=1, description="of a command, per channel")
    saturated_share: Share = Field(description="of the samples at the largest command")
    saturated_levels: int = Field(ge=1, description="distinct commands, above which a plateau is no design")
    longest_lag: Positive = Field(description="within which a response is looked for [s]")
    weak_correlation: Share = Field(description="of response with command")
    wrong_sign: float = Field(ge=-1, lt=0, description="correlation of response with command")
    smallest_gain: Positive = Field(description="of response to command")
    largest_gain: Positive = Field(description="of response to command")
    hopeless_gain: Positive = Field(description="of response to command, or its inverse")
    collinear: Share = Field(description="correlation of the two commands")
    pose_window: Positive = Field(description="over which poses are turned into speeds [s]")

    def longest_step(self, period: float) -> float:
        """Longest time between two readings of one stretch [s] for a source with this period [s]."""
        return max(self.gap_time, self.gap_periods * period)


@cache
def check_settings() -> CheckSettings:
    """The shipped thresholds."""
    return load_checked(CheckSettings, Path(__file__).with_name("check_settings.yaml"))
