"""Settings of the estimation of base effects, read from `settings.yaml`."""

from __future__ import annotations

from functools import cache
from pathlib import Path

from pydantic import Field

from diffdrive_mpc.models.checked_yaml import StrictModel, load_checked
from diffdrive_mpc.models.robot import Positive


class PoseSettings(StrictModel):
    """Settings for the estimation of mount and delay of a pose sensor."""

    window: Positive = Field(description="window over which displacements are compared with poses [s]")
    delays: tuple[float, float] = Field(description="range of the search for the delay [s]")
    outlier: Positive = Field(description="error above which a window is excluded [m]")


class EffectSettings(StrictModel):
    """Bounds, initial values and thresholds; `settings.yaml` states the reasons."""

    parameters: dict[str, tuple[float, float, float]] = Field(description="minimum, maximum, initial value by name")
    resolutions: tuple[Positive, ...] = Field(description="initial values of the step of the rim speed [m/s]")
    resolution_factors: tuple[Positive, ...] = Field(description="factors of the best resolution for a refinement [-]")
    wheel_bases: tuple[Positive, ...] = Field(description="relative initial values of an unknown track [-]")
    track_factors: tuple[Positive, ...] = Field(description="candidate factors of the track of the smoothed fit [-]")
    min_gain: Positive = Field(description="minimum decrease of the logarithm of the held-out error power [-]")
    significance: Positive = Field(description="minimum significance of the decrease [standard errors]")
    max_fit_loss: Positive = Field(description="maximum decrease of FIT by the effects [percentage points]")
    evaluations: int = Field(ge=2, description="maximum evaluations of a search [-]")
    trial_evaluations: int = Field(ge=2, description="maximum evaluations of a search in a comparison [-]")
    difference: Positive = Field(description="finite-difference step, relative to the size of the parameter [-]")
    pose: PoseSettings


@cache
def effect_settings() -> EffectSettings:
    """Load the shipped settings; raise ConfigError if they are invalid."""
    return load_checked(EffectSettings, Path(__file__).with_name("settings.yaml"))
