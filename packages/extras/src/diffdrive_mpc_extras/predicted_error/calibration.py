"""Calibration of the predicted error: features, coefficients, quantiles and populations of drives."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import AfterValidator, Field, field_validator

from diffdrive_mpc.models.checked_yaml import ConfigError, StrictModel, load_checked
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.robot import NotNegative, Positive
from diffdrive_mpc.mpc.config.schema import ControllerConfig, Failure

FEATURES = {
    "floor": "noise of sensors and surface",
    "pose_age": "late or rare poses",
    "speed": "speed and lag",
    "turning": "curvature at speed",
    "acceleration": "change of speed and lag",
    "yaw_acceleration": "change of curvature and lag",
    "first_turns": "first turns (slip is not learned yet)",
    "wheel_speed": "wheels near the maximum speed",
    "pose_age_at_speed": "late or rare poses at speed",
}
"""Features with their descriptions in reports. The lag is that of the model, dead time included.

The error increases with each feature. Earlier turns reduce `first_turns`, because slip is learned in them."""
_BEFORE, _AFTER = 1.0, 0.3
"""Averaging window before and after a place [s]: errors outlast their causes, and the plan looks ahead."""
_LEARNING_ANGLE = 1.0
"""Turned angle over which the error from unlearned slip decays to 1/e [rad]."""
_FREE_SHARE = 0.6
"""Fraction of the maximum wheel speed above which `wheel_speed` is positive [-]."""
_DEFAULT_POSE_AGE = Failure().max_pose_age
"""Default maximum pose age; a longer maximum in a configuration increases `pose_age` [s]."""


def path_features(twist: FloatArray, dt: float, config: ControllerConfig, lag: FloatArray) -> FloatArray:
    """Compute the features of a reference at each of its samples.

    Parameters
    ----------
    twist
        (n, 2) v [m/s], omega [rad/s] of the reference, n at least 2.
    dt
        Time between two samples [s].
    config
        Configuration with track, wheel speed and pose age.
    lag
        (2,) mean delay of both channels of the model, dead time included [s].

    Returns
    -------
    FloatArray
        (n, len(FEATURES)) values, not negative, in the order of `FEATURES`.
    """
    v, omega = np.abs(twist).T
    dv, domega = np.abs(np.gradient(twist, dt, axis=0)).T
    angle = np.cumsum(omega) * dt
    wheel_share = (v + omega * config.wheels.track / 2) / config.limits.wheel_speed
    age = max(config.failure.max_pose_age - _DEFAULT_POSE_AGE, 0.0)
    values = {
        "floor": np.ones_like(v),
        "pose_age": np.full_like(v, age),
        "speed": lag[0] * v,
        "turning": omega,
        "acceleration": lag[0] * dv,
        "yaw_acceleration": lag[1] * v * domega,
        "first_turns": v * omega * np.exp(-angle / _LEARNING_ANGLE),
        "wheel_speed": np.maximum(wheel_share - _FREE_SHARE, 0.0),
        "pose_age_at_speed": age * v,
    }
    return _moving_average(np.column_stack([values[name] for name in FEATURES]), dt)


def _moving_average(values: FloatArray, dt: float) -> FloatArray:
    """Average the columns from `_BEFORE` to `_AFTER` each row, with the first and last rows repeated at the ends."""
    before, after = round(_BEFORE / dt), round(_AFTER / dt)
    padded = np.pad(values, ((before + 1, after), (0, 0)), mode="edge")
    sums = np.cumsum(padded, axis=0)
    return np.asarray((sums[before + after + 1 :] - sums[: -(before + after + 1)]) / (before + after + 1))


Direction = Literal["lateral", "along"]
_FILE = Path(__file__).with_name("calibration.yaml")


def _check_order(values: tuple[float, float]) -> tuple[float, float]:
    if values[0] >= values[1]:
        raise ValueError("give the smaller value before the larger one")
    return values


CalibratedRange = Annotated[tuple[Positive, Positive], AfterValidator(_check_order)]


class ErrorScale(StrictModel):
    """Scale of |error| as a weighted sum of features, and factors of the scale that give the tubes."""

    coefficients: dict[str, NotNegative] = Field(description="error per unit of a feature [m]")
    at_each_place: Positive = Field(description="factor of the tube that contains the stated share at each place [-]")
    everywhere: Positive = Field(description="factor of the tube that contains the stated share of whole drives [-]")

    @field_validator("coefficients")
    @classmethod
    def _check_features(cls, values: dict[str, float]) -> dict[str, float]:
        unknown = sorted(values.keys() - FEATURES.keys())
        if unknown:
            raise ValueError(f"unknown feature '{unknown[0]}'; known: {', '.join(FEATURES)}")
        if not values.get("floor"):
            raise ValueError("floor must be above zero: a robot at rest has an error")
        return values

    @property
    def row(self) -> FloatArray:
        """(len(FEATURES),) coefficients in the order of the features."""
        return np.array([self.coefficients.get(name, 0.0) for name in FEATURES])


class ErrorPopulation(StrictModel):
    """Population of robots, surfaces and sensors, with the errors of its drives."""

    description: str = Field(min_length=1, description="description of the drives")
    drives: dict[Literal["fit", "calibration"], Annotated[int, Field(ge=1)]] = Field(description="number of drives")
    lateral: ErrorScale = Field(description="scale of the lateral error")
    along: ErrorScale = Field(description="scale of the longitudinal error")


class CalibratedRanges(StrictModel):
    """Ranges (minimum, maximum) of the paths and models of the calibration; values above them give a warning."""

    v: CalibratedRange = Field(description="maximum speed of a path [m/s]")
    omega: CalibratedRange = Field(description="maximum yaw rate of a path [rad/s]")
    lag_v: CalibratedRange = Field(description="dead time plus lag of v in the model [s]")
    lag_omega: CalibratedRange = Field(description="dead time plus lag of omega in the model [s]")


class ErrorCalibration(StrictModel):
    """Calibration of the predicted error."""

    level: Annotated[float, Field(gt=0.5, lt=1.0)] = Field(description="share of drives inside a tube [-]")
    provenance: str = Field(min_length=1, description="source of the calibration")
    calibrated: CalibratedRanges = Field(description="ranges of the paths and models of the calibration")
    populations: dict[str, ErrorPopulation] = Field(min_length=1, description="populations by name")

    def population(self, name: str) -> ErrorPopulation:
        """Return the population with this name; raise ConfigError if it does not exist."""
        if name not in self.populations:
            raise ConfigError(f"unknown population '{name}': give {' or '.join(self.populations)}")
        return self.populations[name]


def load_calibration(path: str | Path | None = None) -> ErrorCalibration:
    """Load a calibration, by default the shipped calibration; raise ConfigError if the file is invalid."""
    return _load_shipped() if path is None else load_checked(ErrorCalibration, Path(path))


@cache
def _load_shipped() -> ErrorCalibration:
    return load_checked(ErrorCalibration, _FILE)
