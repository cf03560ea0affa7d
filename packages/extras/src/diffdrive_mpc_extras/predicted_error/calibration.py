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
from diffdrive_mpc.mpc.config.schema import ControllerConfig, Failure

FEATURES = {
    "floor": "noise of sensors and floor",
    "pose_age": "late or rare poses",
    "speed": "speed and lag",
    "turning": "curvature at speed",
    "acceleration": "change of speed and lag",
    "yaw_acceleration": "change of curvature and lag",
    "first_turns": "first turns (slip is still learned)",
    "wheel_speed": "wheels near their top speed",
    "pose_age_at_speed": "late or rare poses at speed",
}
"""By name what a report calls them; lag is that of the model with its dead time. The error grows with each.

Turns driven before a place make `first_turns` smaller there: slip is learned from them."""
_BEFORE, _AFTER = 1.0, 0.3
"""Features are means from so long before a place to after it [s]: an error outlasts its cause; look-ahead is early."""
_LEARNED = 1.0
"""The effect of what is not yet learned decays with the angle that was turned [rad]."""
_FREE_SHARE = 0.6
"""Share of the top speed of wheels from which on it counts."""
_USUAL_AGE = Failure().max_pose_age
"""Pose age above which poses count as late [s]."""


def path_features(twist: FloatArray, dt: float, config: ControllerConfig, lag: FloatArray) -> FloatArray:
    """Compute the features of a reference at each of its samples.

    Parameters
    ----------
    twist
        (n, 2) v [m/s], omega [rad/s] of the reference, n at least 2.
    dt
        Time between two samples [s].
    config
        Tracks, wheel speeds and pose ages that it states.
    lag
        (2,) mean delay of both channels of the model, dead time included [s].

    Returns
    -------
    FloatArray
        (n, len(FEATURES)), none negative, in the order of `FEATURES`.
    """
    v, omega = np.abs(twist).T
    dv, domega = np.abs(np.gradient(twist, dt, axis=0)).T
    turned = np.cumsum(omega) * dt
    share = (v + omega * config.wheels.track / 2) / config.limits.wheel_speed
    age = max(config.failure.max_pose_age - _USUAL_AGE, 0.0)
    values = {
        "floor": np.ones_like(v),
        "pose_age": np.full_like(v, age),
        "speed": lag[0] * v,
        "turning": omega,
        "acceleration": lag[0] * dv,
        "yaw_acceleration": lag[1] * v * domega,
        "first_turns": v * omega * np.exp(-turned / _LEARNED),
        "wheel_speed": np.maximum(share - _FREE_SHARE, 0.0),
        "pose_age_at_speed": age * v,
    }
    return _around(np.column_stack([values[name] for name in FEATURES]), dt)


def _around(values: FloatArray, dt: float) -> FloatArray:
    """Average the columns from `_BEFORE` to `_AFTER` each row; repeat the first and last rows beyond the ends."""
    before, after = round(_BEFORE / dt), round(_AFTER / dt)
    longer = np.pad(values, ((before + 1, after), (0, 0)), mode="edge")
    sums = np.cumsum(longer, axis=0)
    return np.asarray((sums[before + after + 1 :] - sums[: -(before + after + 1)]) / (before + after + 1))


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
    lag_v: CalibratedRange = Field(description="dead time plus lag of v of the model; a warning is given above it [s]")
    lag_omega: CalibratedRange = Field(description="the same of omega [s]")


class ErrorCalibration(StrictModel):
    """Calibration of the predicted error."""

    level: Annotated[float, Field(gt=0.5, lt=1.0)] = Field(description="share of drives inside a tube [-]")
    provenance: str = Field(min_length=1, description="how it was made")
    calibrated: CalibratedRanges = Field(description="for which paths and models it holds")
    populations: dict[str, ErrorPopulation] = Field(min_length=1, description="by name")

    def population(self, name: str) -> ErrorPopulation:
        """Return the population with a name; raise ConfigError if there is none."""
        if name not in self.populations:
            raise ConfigError(f"unknown population '{name}': give {' or '.join(self.populations)}")
        return self.populations[name]


def load_calibration(path: str | Path | None = None) -> ErrorCalibration:
    """Read a calibration, by default the shipped one; raises ConfigError when the file has a mistake."""
    return _shipped() if path is None else load_checked(ErrorCalibration, Path(path))


@cache
def _shipped() -> ErrorCalibration:
    return load_checked(ErrorCalibration, _FILE)
