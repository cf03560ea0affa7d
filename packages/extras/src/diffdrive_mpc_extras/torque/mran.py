"""A minimal resource-allocating network: radial basis functions that are added, adapted and taken out while learning.

Sources: Ordonez et al., 2017 (P4), section 3.1, equations 16 to 23; the algorithm is that of Lu, Sundararajan and
Saratchandran, Neural Computation 9(2), 1997. One input and one output.
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


def _rising(name: str, values: Range) -> None:
    if not values[0] < values[1]:
        raise ValueError(f"{name} {list(values)}: the first has to be the lower one")


class MranSettings(StrictModel):
    """A minimal resource-allocating network: conditions of its growth and pruning, and its learning rate."""

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
    """Inputs of a curve, and their valid ranges."""

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


_PER_UNIT = 3


class MranNetwork:
    """y = a0 + sum of a_j exp(-(x - d_j)^2 / s_j^2), learned sample by sample.

    A sample that is not finite is left out. Its output is always finite: parameters that an update would make not
    finite are kept as they were.

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
        self._idle = np.zeros(0, dtype=int)
        self._distance = settings.distance[0]

    @property
    def units(self) -> FloatArray:
        """(N, 3) amplitude, centre and width of each hidden unit."""
        return self._parameters[1:].reshape(-1, _PER_UNIT).copy()

    @property
    def offset(self) -> float:
        """a0."""
        return float(self._parameters[0])

    def __call__(self, x: ArrayLike) -> FloatArray:
        """Compute outputs for inputs x (...)."""
        inputs = np.asarray(x, dtype=float)
        amplitude, centre, width = self._parameters[1:].reshape(-1, _PER_UNIT).T
        bells = np.exp(-(((inputs[..., None] - centre) / width) ** 2))
        return np.asarray(self._parameters[0] + bells @ amplitude)

    def learn(self, x: float, y: float) -> float:
        """Take in one sample; returns the error that it had before, NaN for a sample that is left out."""
        if not (math.isfinite(x) and math.isfinite(y)):
            return math.nan
        settings = self._settings
        amplitude, centre, width = self._parameters[1:].reshape(-1, _PER_UNIT).T
        away = x - centre
        bells = np.exp(-((away / width) ** 2))
        error = y - float(self._parameters[0] + bells @ amplitude)
        self._errors.append(error)
        self._distance = max(settings.distance[1], self._distance * settings.distance_decay)
        nearest = float(np.abs(away).min()) if away.size else math.inf
        rms = math.sqrt(sum(error * error for error in self._errors) / settings.window)
        grown = (
            abs(error) > settings.instant_error
            and rms > settings.window_error
            and nearest > self._distance
            and len(centre) < settings.most_units
        )
        if grown:
            self._grow(x, error, nearest)
        else:
            self._adapt(error, amplitude, away, width, bells)
        self._prune(x)
        return error

    def restart_doubt(self) -> None:
        """Increase the uncertainty of learned parameters: before another terrain, or after a doubtful prior."""
        self._covariance = np.diag(self._doubts(len(self._parameters)))
        self._distance = self._settings.distance[0]
        self._errors.clear()

    def _doubts(self, size: int) -> FloatArray:
        """Return variances (size,) of unknown parameters."""
        doubts = np.full(size, self._settings.shape_doubt)
        doubts[0], doubts[1::_PER_UNIT] = self._settings.doubt, self._settings.doubt
        return doubts

    def _grow(self, x: float, error: float, nearest: float) -> None:
        """Add a unit at the sample, as wide as its distance from the others, that compensates its error."""
        settings = self._settings
        width = np.clip(settings.overlap * nearest, *settings.width)
        self._parameters = np.append(self._parameters, [error, x, width])
        size = len(self._parameters)
        covariance = np.diag(self._doubts(size))
        covariance[:-_PER_UNIT, :-_PER_UNIT] = self._covariance
        self._covariance, self._idle = covariance, np.append(self._idle, 0)

    def _adapt(
        self, error: float, amplitude: FloatArray, away: FloatArray, width: FloatArray, bells: FloatArray
    ) -> None:
        """Update all parameters by one step of an extended Kalman filter."""
        settings = self._settings
        slope = amplitude * bells * 2 * away / width**2
        gradient = np.concatenate([[1.0], np.stack([bells, slope, slope * away / width], axis=-1).ravel()])
        covariance = self._covariance + settings.drift * np.eye(len(gradient))
        projected = covariance @ gradient
        innovation = float(gradient @ projected) + settings.noise**2
        parameters = self._parameters + projected * (error / innovation)
        covariance = covariance - np.outer(projected, projected) / innovation
        if not (np.isfinite(parameters).all() and np.isfinite(covariance).all()):
            return
        parameters[3::_PER_UNIT] = np.clip(parameters[3::_PER_UNIT], *settings.width)
        self._parameters, self._covariance = parameters, 0.5 * (covariance + covariance.T)

    def _prune(self, x: float) -> None:
        """Remove units whose output was negligible for long, although the inputs were near them."""
        amplitude, centre, width = self._parameters[1:].reshape(-1, _PER_UNIT).T
        if not amplitude.size:
            return
        output = np.abs(amplitude * np.exp(-(((x - centre) / width) ** 2)))
        covered = np.abs(x - centre) < width
        small = np.abs(amplitude) <= self._settings.prune_below * max(np.abs(amplitude).max(), output.max())
        self._idle = np.where(covered, np.where(small, self._idle + 1, 0), self._idle)
        keep = self._idle < self._settings.prune_after
        if keep.all():
            return
        rows = np.concatenate([[True], np.repeat(keep, _PER_UNIT)])
        self._parameters, self._covariance = self._parameters[rows], self._covariance[np.ix_(rows, rows)]
        self._idle = self._idle[keep]
