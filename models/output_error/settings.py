"""Search bounds and warning thresholds of the estimator, read from `settings.yaml`."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Annotated

from pydantic import Field

from diffdrive_mpc.models.checked_yaml import StrictModel, load_checked
from diffdrive_mpc.models.robot import Positive

Range = tuple[Positive, Positive]


class LimitSettings(StrictModel):
    """Settings of the search for limits of the base."""

    levels: tuple[Positive, ...] = Field(description="that are tried, parts of the largest command [-]")
    durations: tuple[Positive, ...] = Field(description="that are tried, of ramps from zero to the largest command [s]")
    evaluations: int = Field(ge=2, description="of the model for each of them")
    share: Positive = Field(lt=1, description="least share of samples that a limit changes [-]")
    evidence: Positive = Field(description="least fall of the information criterion [-]")
    strong_evidence: Positive = Field(description="decrease above which blocks only have to agree [-]")
    held_out_evidence: Positive = Field(
        description="least fall of the log of the mean square error on blocks held out, times effective samples [-]"
    )


class ScatterSettings(StrictModel):
    """When parts of a log are said to differ."""

    blocks: tuple[Annotated[int, Field(ge=3)], ...] = Field(description="numbers of blocks of equal length")
    certain: Positive = Field(lt=1, description="quantile of a variance between blocks, up to which it is chance [-]")


class HeldOutSettings(StrictModel):
    """Settings of the held-out blocks of the records."""

    blocks: int = Field(ge=2, description="of equal length")
    fewest_readings: int = Field(ge=5, description="of each output in a part of a record")


class WarningSettings(StrictModel):
    """When a parameter is said to be badly known."""

    relative_deviation: Positive = Field(description="standard deviation over value [-]")
    delay_deviation: Positive = Field(description="standard deviation of dead time and lag together over both [-]")
    least_delay_deviation: Positive = Field(description="below which they are known well enough [s]")
    condition: Positive = Field(description="condition number of the scaled information matrix [-]")


class EstimatorSettings(StrictModel):
    """Bounds, first guesses and thresholds of the estimator."""

    longest_dead_time: Positive = Field(description="[s]")
    lag: Range = Field(description="sum of both time constants [s]")
    short: Range = Field(description="product of both time constants over their sum [s]")
    gain: Range = Field(description="[-]")
    track: Range = Field(description="[m]")
    start_dead_times: tuple[float, ...] = Field(description="grid of first guesses [s]")
    start_frequencies: tuple[Positive, ...] = Field(description="grid of first guesses [rad/s]")
    start_deviation: Positive = Field(description="of a stretch from a settled state, part of the usual deviation [-]")
    impulse_response: Positive = Field(description="length of the impulse response an SSM starts from [s]")
    limits: LimitSettings
    held_out: HeldOutSettings
    scatter: ScatterSettings
    warn: WarningSettings
    residual_lag: Positive = Field(description="longest lag of the residuals' correlations [s]")


@cache
def estimator_settings() -> EstimatorSettings:
    """Read `settings.yaml`; raises ConfigError on a mistake in it."""
    return load_checked(EstimatorSettings, Path(__file__).parent / "settings.yaml")
