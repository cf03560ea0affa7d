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

    levels: tuple[Positive, ...] = Field(description="candidate limits as shares of the maximum command [-]")
    durations: tuple[Positive, ...] = Field(
        description="candidate durations of ramps from 0 to the maximum command [s]"
    )
    fitted: int = Field(ge=1, description="number of candidates that are fitted after a linear estimate of all")
    evaluations: int = Field(ge=2, description="model evaluations per fitted candidate")
    share: Positive = Field(lt=1, description="minimum share of samples that a limit changes [-]")
    evidence: Positive = Field(description="minimum decrease of the information criterion [-]")
    strong_evidence: Positive = Field(description="decrease above which held-out blocks must only not get worse [-]")
    held_out_evidence: Positive = Field(
        description="minimum decrease of the log mean square error on held-out blocks, times effective samples [-]"
    )


class ScatterSettings(StrictModel):
    """Settings of the test for differences between parts of a log."""

    blocks: tuple[Annotated[int, Field(ge=3)], ...] = Field(description="numbers of blocks of equal length")
    certain: Positive = Field(lt=1, description="quantile below which a variance between blocks counts as chance [-]")


class HeldOutSettings(StrictModel):
    """Settings of the held-out blocks of the records."""

    blocks: int = Field(ge=2, description="number of blocks of equal length")
    min_readings: int = Field(ge=5, description="minimum number of readings of each output in a part of a record")


class WarningSettings(StrictModel):
    """Thresholds for warnings about uncertain parameters."""

    relative_deviation: Positive = Field(description="maximum ratio of standard deviation to value [-]")
    delay_deviation: Positive = Field(description="maximum relative standard deviation of dead time plus lag [-]")
    min_delay_deviation: Positive = Field(
        description="maximum standard deviation of dead time plus lag without a warning [s]"
    )
    condition: Positive = Field(description="maximum condition number of the scaled information matrix [-]")


class EstimatorSettings(StrictModel):
    """Bounds, initial guesses and thresholds of the estimator."""

    max_dead_time: Positive = Field(description="maximum dead time [s]")
    lag: Range = Field(description="sum of both time constants [s]")
    short: Range = Field(description="product of both time constants over their sum [s]")
    gain: Range = Field(description="steady-state gain [-]")
    track: Range = Field(description="track of the firmware [m]")
    start_dead_times: tuple[float, ...] = Field(description="grid of initial dead times [s]")
    start_frequencies: tuple[Positive, ...] = Field(description="grid of initial frequencies [rad/s]")
    start_deviation: Positive = Field(
        description="prior deviation of an initial state from steady state, relative to its rms deviation [-]"
    )
    impulse_response: Positive = Field(description="length of the impulse response for the initial SSM [s]")
    limits: LimitSettings
    held_out: HeldOutSettings
    scatter: ScatterSettings
    warn: WarningSettings
    residual_lag: Positive = Field(description="maximum lag of the residual correlations [s]")


@cache
def estimator_settings() -> EstimatorSettings:
    """Read `settings.yaml`; raise ConfigError if it is invalid."""
    return load_checked(EstimatorSettings, Path(__file__).parent / "settings.yaml")
