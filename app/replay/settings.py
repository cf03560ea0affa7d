"""What a replay counts as worth saying."""

from __future__ import annotations

from functools import cache
from pathlib import Path

from diffdrive_mpc.models.checked_yaml import StrictModel, load_checked


class ReplaySettings(StrictModel):
    """See settings.yaml beside this file."""

    exact: float
    smoothing: float
    grid: float
    late_tick: float
    share_at_limit: float
    beyond_limit: float
    dead_time_wrong: float
    dead_time_deviation: float
    yaw_gain_far: float
    v_offset_far: float
    innovations_large: float
    innovations_small: float
    least_readings: int
    moving_v: float
    moving_omega: float
    share_unused: float


@cache
def replay_settings() -> ReplaySettings:
    """The shipped ones."""
    return load_checked(ReplaySettings, Path(__file__).parent / "settings.yaml")
