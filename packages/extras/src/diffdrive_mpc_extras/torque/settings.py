"""Settings of the learned torque curves: `settings.yaml` says what each is and where it comes from."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Self

from pydantic import Field, model_validator

from diffdrive_mpc.models.checked_yaml import StrictModel, load_checked
from diffdrive_mpc.models.robot import NotNegative, Positive, Share

Range = tuple[Positive, Positive]


def _rising(name: str, values: Range) -> None:
    if not values[0] < values[1]:
        raise ValueError(f"{name} {list(values)}: the first has to be the lower one")


class MranSettings(StrictModel):
    """A minimal resource-allocating network: when it grows, shrinks, and how fast it learns."""

    most_units: int = Field(ge=1, le=1000, description="hidden units at most")
    instant_error: Positive = Field(description="E1: a unit more only for an error above this")
    window_error: Positive = Field(description="E2: and for an RMS error over the window above this")
    distance: Range = Field(description="E3: and farther than this from every unit; to and from, as it shrinks")
    distance_decay: Share = Field(description="by which E3 shrinks at each sample")
    window: int = Field(ge=1, description="M: samples of the window")
    overlap: Positive = Field(description="kappa: width of a new unit over its distance to the nearest one")
    width: Range = Field(description="within which a unit's width is kept")
    prune_below: NotNegative = Field(description="a unit whose share of the greatest output stays below this")
    prune_after: int = Field(ge=1, description="for so many samples in a row goes")
    noise: Positive = Field(description="standard deviation of a measured output")
    drift: NotNegative = Field(description="variance that each parameter gains at a sample")
    doubt: Positive = Field(description="variance of offset and amplitudes before they are learned")
    shape_doubt: Positive = Field(description="variance of centres and widths")

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        _rising("width", self.width)
        if self.distance[0] < self.distance[1]:
            raise ValueError(f"distance {list(self.distance)}: E3 shrinks, so the first is the larger one")
        return self


class CurveSettings(StrictModel):
    """What the inputs are, and within which bounds a curve speaks."""

    radii: Range = Field(description="turn radii within which a curve is asked [m]")
    speed: Positive = Field(description="at which curves stand [m/s]")
    speed_exponent: float = Field(description="a turn at speed v counts as one of radius R (speed / v)^exponent [-]")
    settling: NotNegative = Field(description="after a change of the command nothing is learned for so long [s]")
    prior_radii: int = Field(ge=3, description="triplets of the prior")
    prior_passes: int = Field(ge=1, description="how often they are shown")
    margin: Share = Field(description="what a curve says stays within this share of the torque limit")

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        _rising("radii", self.radii)
        return self


class TorqueSettings(StrictModel):
    """Both."""

    network: MranSettings
    curves: CurveSettings


@cache
def load_torque_settings(path: str | Path | None = None) -> TorqueSettings:
    """Read the settings; the shipped ones without a path. Raises ConfigError on a mistake in the file."""
    return load_checked(TorqueSettings, path or Path(__file__).parent / "settings.yaml")
