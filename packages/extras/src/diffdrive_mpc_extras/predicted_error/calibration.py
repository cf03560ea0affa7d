"""The calibration of the predicted error: coefficients, quantiles, and which drives they come from."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import AfterValidator, Field, field_validator

from diffdrive_mpc.models.checked_yaml import ConfigError, StrictModel, load_checked
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.robot import NotNegative, Positive
from diffdrive_mpc_extras.predicted_error.features import FEATURES

Direction = Literal["lateral", "along"]
_FILE = Path(__file__).with_name("calibration.yaml")


def _sorted(values: tuple[float, float]) -> tuple[float, float]:
    if values[0] >= values[1]:
        raise ValueError("give the smaller value before the larger one")
    return values


CalibratedRange = Annotated[tuple[Positive, Positive], AfterValidator(_sorted)]


class ErrorScale(StrictModel):
    """The scale of |error| as a sum over features, and by which factors of it drives stay inside."""

    coefficients: dict[str, NotNegative] = Field(description="error for each unit of a feature [m]")
    at_each_place: Positive = Field(description="factor inside which the stated share of drives is at a place [-]")
    everywhere: Positive = Field(description="factor inside which that share of drives is all the way [-]")

    @field_validator("coefficients")
    @classmethod
    def _known(cls, values: dict[str, float]) -> dict[str, float]:
        unknown = sorted(values.keys() - FEATURES.keys())
        if unknown:
            raise ValueError(f"unknown feature '{unknown[0]}'; known: {', '.join(FEATURES)}")
        if not values.get("floor"):
            raise ValueError("floor has to be above zero: a robot that stands has an error, too")
        return values

    @property
    def row(self) -> FloatArray:
        """(len(FEATURES),) coefficients in the order of the features."""
        return np.array([self.coefficients.get(name, 0.0) for name in FEATURES])


class ErrorPopulation(StrictModel):
    """A population of robots, floors and sensors, and the errors that its drives had."""

    description: str = Field(min_length=1, description="which drives")
    drives: dict[Literal["fit", "calibration"], Annotated[int, Field(ge=1)]] = Field(description="how many")
    lateral: ErrorScale = Field(description="distance from the path")
    along: ErrorScale = Field(description="ahead of the reference or behind it, along the path")


class CalibratedRanges(StrictModel):
    """For which paths and models the tubes were calibrated, from the least to the largest value."""

    v: CalibratedRange = Field(description="top speed of a path; a warning is given above it, not below [m/s]")
    omega: CalibratedRange = Field(description="top yaw rate of a path; a warning is given above it, not below [rad/s]")
    lag_v: CalibratedRange = Field(description="lag of v of the model, dead time included; else refused [s]")
    lag_omega: CalibratedRange = Field(description="lag of omega of the model, dead time included; else refused [s]")


class ErrorCalibration(StrictModel):
    """What the predicted error is made of."""

    level: Annotated[float, Field(gt=0.5, lt=1.0)] = Field(description="share of drives inside a tube [-]")
    provenance: str = Field(min_length=1, description="how it was made")
    calibrated: CalibratedRanges = Field(description="for which paths and models it holds")
    populations: dict[str, ErrorPopulation] = Field(min_length=1, description="by name")

    def population(self, name: str) -> ErrorPopulation:
        """The population of a name; raises ConfigError if there is none."""
        if name not in self.populations:
            raise ConfigError(f"unknown population '{name}': give {' or '.join(self.populations)}")
        return self.populations[name]


def load_calibration(path: str | Path | None = None) -> ErrorCalibration:
    """Read a calibration, by default the shipped one; raises ConfigError when the file has a mistake."""
    return _shipped() if path is None else load_checked(ErrorCalibration, Path(path))


@cache
def _shipped() -> ErrorCalibration:
    return load_checked(ErrorCalibration, _FILE)
