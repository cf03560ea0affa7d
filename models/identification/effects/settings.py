"""Settings of the estimation of base effects, read from `settings.yaml`."""

from __future__ import annotations

from functools import cache
from pathlib import Path

from pydantic import Field

from diffdrive_mpc.models.checked_yaml import StrictModel, load_checked
from diffdrive_mpc.models.robot import Positive


class PoseSettings(StrictModel):
    """Settings of the search for place and delay of a pose sensor."""

    window: Positive = Field(description="over which displacements are held against poses [s]")
    delays: tuple[float, float] = Field(description="between which the delay is looked for [s]")
    outlier: Positive = Field(description="error of a window beyond which it is left out [m]")


class EffectSettings(StrictModel):
    """Bounds, first guesses and thresholds; the reasons are in `settings.yaml`."""

    parameters: dict[str, tuple[float, float, float]] = Field(description="lowest, highest, first guess")
    resolutions: tuple[Positive, ...] = Field(description="steps of the rim speed that are tried [m/s]")
    finer: tuple[Positive, ...] = Field(description="multiples of the best one that are tried")
    wheel_bases: tuple[Positive, ...] = Field(description="tracks to start from where it is not known [-]")
    tracks: tuple[Positive, ...] = Field(description="parts of the track to start from [-]")
    worth: Positive = Field(description="least fall of the logarithm of the held-out error power")
    certain: Positive = Field(description="standard errors between blocks by which an effect has to be worth it")
    most_lost: Positive = Field(description="FIT that a channel may lose against the plain model [percentage points]")
    evaluations: int = Field(ge=2, description="steps of a search")
    trial: int = Field(ge=2, description="steps of the search in a comparison")
    difference: Positive = Field(description="step of the finite differences, part of a parameter's usual size")
    pose: PoseSettings


@cache
def effect_settings() -> EffectSettings:
    """Load the shipped settings; raise ConfigError for a mistake in them."""
    return load_checked(EffectSettings, Path(__file__).with_name("settings.yaml"))
