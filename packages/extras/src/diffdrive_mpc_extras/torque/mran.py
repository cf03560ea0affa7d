"""Minimal resource-allocating network (MRAN): radial basis functions that are added, adapted and pruned online.

The network has one input and one output. Sources: Ordonez et al., 2017 (P4), section 3.1, equations 16 to 23; the
algorithm is that of Lu, Sundararajan and Saratchandran, Neural Computation 9(2), 1997.
"""

from __future__ import annotations

import math
from collections import deque
from functools import cache
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field, model_validator

from diffdrive_mpc.models.checked_yaml import StrictModel, load_checked
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.robot import NotNegative, Positive, Share

Range = tuple[Positive, Positive]


def _check_ascending(name: str, values: Range) -> None:
    if not values[0] < values[1]:
        raise ValueError(f"{name} {list(values)}: the first value must be below the second")


class MranSettings(StrictModel):
    """Settings of growth, pruning and learning of the network."""

    most_units: int = Field(ge=1, le=1000, description="maximum number of hidden units")
    instant_error: Positive = Field(description="minimum error for a new unit, E1")
    window_error: Positive = Field(description="minimum RMS error over the window for a new unit, E2")
    distance: Range = Field(description="initial and final minimum distance of a new unit from all units, E3")
    distance_decay: Share = Field(description="factor on E3 at each sample")
    window: int = Field(ge=1, description="number of samples in the window, M")
    overlap: Positive = Field(description="width of a new unit over its distance from the nearest unit, kappa")
    width: Range = Field(description="minimum and maximum width of a unit")
    prune_below: NotNegative = Field(description="output of a unit over the maximum output below which it is idle")
    prune_after: int = Field(ge=1, description="number of consecutive idle samples after which a unit is removed")
    noise: Positive = Field(description="standard deviation of a measured output")
    drift: NotNegative = Field(description="increase of the variance of each parameter at a sample")
    doubt: Positive = Field(description="initial variance of offset and amplitudes")
    shape_doubt: Positive = Field(description="initial variance of centres and widths")

    @model_validator(mode="after")
    def _check_ranges(self) -> Self:
        _check_ascending("width", self.width)
        if self.distance[0] < self.distance[1]:
            raise ValueError(f"distance {list(self.distance)}: E3 decreases, so the first value must be the larger one")
        return self


class CurveSettings(StrictModel):
    """Settings of the torque curves."""

    radii: Range = Field(description="minimum and maximum turn radius of a curve [m]")
    speed: Positive = Field(description="reference speed of the curves [m/s]")
    speed_exponent: float = Field(
        description="exponent e of the equivalent radius R (speed / v)^e of a turn at speed v [-]"
    )
    settling: NotNegative = Field(description="settling time after a change of the command, without learning [s]")
    prior_radii: int = Field(ge=3, description="number of radii of the prior")
    prior_passes: int = Field(ge=1, description="number of training passes over the prior")
    margin: Share = Field(description="maximum torque of a curve over the torque limit")

    @model_validator(mode="after")
    def _check_radii(self) -> Self:
        _check_ascending("radii", self.radii)
        return self


class TorqueSettings(StrictModel):
    """Settings of networks and curves."""

    network: MranSettings
    curves: CurveSettings


@cache
def load_torque_settings(path: str | Path | None = None) -> TorqueSettings:
    """Read a settings file, by default the shipped one; raises ConfigError if the file is invalid."""
    return load_checked(TorqueSettings, path or Path(__file__).parent / "settings.yaml")


_UNIT_PARAMETERS = 3


class MranNetwork:
    """Network y = a0 + sum of a_j exp(-(x - d_j)^2 / s_j^2), learned sample by sample.

    Samples that are not finite are ignored, and so are updates with parameters that are not finite. The output is
    therefore always finite.

    Parameters
    ----------
    settings
        Settings of growth, pruning and learning.
    """

    def __init__(self, settings: MranSettings) -> None:
        self._settings = settings
        # a0, then a_j, d_j, s_j of each unit.
        self._parameters = np.zeros(1)
        self._covariance = settings.doubt * np.eye(1)
        self._errors: deque[float] = deque(maxlen=settings.window)
        self._idle_samples = np.zeros(0, dtype=int)
        self._distance = settings.distance[0]

    @property
    def units(self) -> FloatArray:
        """(N, 3) amplitude, centre and width of each hidden unit."""
        return self._parameters[1:].reshape(-1, _UNIT_PARAMETERS).copy()

    @property
    def offset(self) -> float:
        """Offset a0."""
        return float(self._parameters[0])

    def __call__(self, x: ArrayLike) -> FloatArray:
        """Compute outputs for inputs x (...)."""
        inputs = np.asarray(x, dtype=float)
        amplitude, centre, width = self._parameters[1:].reshape(-1, _UNIT_PARAMETERS).T
        activations = np.exp(-(((inputs[..., None] - centre) / width) ** 2))
        return np.asarray(self._parameters[0] + activations @ amplitude)

    def learn(self, x: float, y: float) -> float:
        """Learn one sample; return the error of the output before the update, NaN for an ignored sample."""
        if not (math.isfinite(x) and math.isfinite(y)):
            return math.nan
        settings = self._settings
        amplitude, centre, width = self._parameters[1:].reshape(-1, _UNIT_PARAMETERS).T
        offsets = x - centre
        activations = np.exp(-((offsets / width) ** 2))
        error = y - float(self._parameters[0] + activations @ amplitude)
        self._errors.append(error)
        self._distance = max(settings.distance[1], self._distance * settings.distance_decay)
        nearest = float(np.abs(offsets).min()) if offsets.size else math.inf
        rms = math.sqrt(sum(error * error for error in self._errors) / settings.window)
        needs_unit = (
            abs(error) > settings.instant_error
            and rms > settings.window_error
            and nearest > self._distance
            and len(centre) < settings.most_units
        )
        if needs_unit:
            self._add_unit(x, error, nearest)
        else:
            self._adapt(error, amplitude, offsets, width, activations)
        self._prune(x)
        return error

    def reset_covariance(self) -> None:
        """Reset the covariance of the parameters: before another terrain, or after training with a prior."""
        self._covariance = np.diag(self._initial_variances(len(self._parameters)))
        self._distance = self._settings.distance[0]
        self._errors.clear()

    def _initial_variances(self, size: int) -> FloatArray:
        """Return the variances (size,) of parameters before learning."""
        variances = np.full(size, self._settings.shape_doubt)
        variances[0], variances[1::_UNIT_PARAMETERS] = self._settings.doubt, self._settings.doubt
        return variances

    def _add_unit(self, x: float, error: float, nearest: float) -> None:
        """Add a unit at the sample that compensates its error; the width follows from the distance `nearest`."""
        settings = self._settings
        width = np.clip(settings.overlap * nearest, *settings.width)
        self._parameters = np.append(self._parameters, [error, x, width])
        size = len(self._parameters)
        covariance = np.diag(self._initial_variances(size))
        covariance[:-_UNIT_PARAMETERS, :-_UNIT_PARAMETERS] = self._covariance
        self._covariance, self._idle_samples = covariance, np.append(self._idle_samples, 0)

    def _adapt(
        self, error: float, amplitude: FloatArray, offsets: FloatArray, width: FloatArray, activations: FloatArray
    ) -> None:
        """Update all parameters by one step of an extended Kalman filter."""
        settings = self._settings
        slope = amplitude * activations * 2 * offsets / width**2
        gradient = np.concatenate([[1.0], np.stack([activations, slope, slope * offsets / width], axis=-1).ravel()])
        covariance = self._covariance + settings.drift * np.eye(len(gradient))
        projected = covariance @ gradient
        innovation = float(gradient @ projected) + settings.noise**2
        parameters = self._parameters + projected * (error / innovation)
        covariance = covariance - np.outer(projected, projected) / innovation
        if not (np.isfinite(parameters).all() and np.isfinite(covariance).all()):
            return
        parameters[3::_UNIT_PARAMETERS] = np.clip(parameters[3::_UNIT_PARAMETERS], *settings.width)
        self._parameters, self._covariance = parameters, 0.5 * (covariance + covariance.T)

    def _prune(self, x: float) -> None:
        """Remove units with a negligible output at many consecutive inputs near them."""
        amplitude, centre, width = self._parameters[1:].reshape(-1, _UNIT_PARAMETERS).T
        if not amplitude.size:
            return
        output = np.abs(amplitude * np.exp(-(((x - centre) / width) ** 2)))
        is_near = np.abs(x - centre) < width
        is_small = np.abs(amplitude) <= self._settings.prune_below * max(np.abs(amplitude).max(), output.max())
        self._idle_samples = np.where(is_near, np.where(is_small, self._idle_samples + 1, 0), self._idle_samples)
        keep = self._idle_samples < self._settings.prune_after
        if keep.all():
            return
        rows = np.concatenate([[True], np.repeat(keep, _UNIT_PARAMETERS)])
        self._parameters, self._covariance = self._parameters[rows], self._covariance[np.ix_(rows, rows)]
        self._idle_samples = self._idle_samples[keep]
