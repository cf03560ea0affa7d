"""Parametrisation of a transfer function with two poles and no zeros for the estimator."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from diffdrive_mpc.models.interface import AnyArray, FloatArray
from diffdrive_mpc.models.output_error.settings import estimator_settings
from diffdrive_mpc.models.structures.model_file import TransferFunction, TwoPoles


@dataclass(frozen=True)
class TwoPolesForm:
    """`ChannelForm` gain / (1 + lag s + lag short s^2) with the logarithms of gain, lag and short as parameters.

    The parameters remain moderate for complex poles, and for a pole that is much faster than the other.

    Attributes
    ----------
    min_short
        Minimum of `short` [s]: the product of both time constants over their sum, which approximates the shorter
        constant. By default from the settings.
    """

    min_short: float | None = None
    file: ClassVar[type[TransferFunction]] = TwoPoles
    kinds: ClassVar[Mapping[str, str]] = {"log_gain": "gain", "log_lag": "lag", "log_short": "second lag"}
    description: ClassVar[str] = "two poles, no zeros"
    names: ClassVar[tuple[str, ...]] = tuple(kinds)
    may_be_zero: ClassVar[tuple[str, ...]] = ()

    @property
    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Lower and upper bounds (3,) from the settings."""
        settings = estimator_settings()
        short = (self.min_short or settings.short[0], settings.short[1])
        ranges = np.log([settings.gain, settings.lag, short])
        return ranges[:, 0], ranges[:, 1]

    def values(self, parameters: AnyArray) -> AnyArray:
        """Compute gain [-], natural frequency [rad/s] and damping [-] (3,) from `parameters` (3,)."""
        gain, lag, short = np.exp(parameters)
        return np.array([gain, 1 / np.sqrt(lag * short), 0.5 * np.sqrt(lag / short)])

    def parameters(self, values: FloatArray) -> FloatArray:
        """Compute the parameters (3,) from gain, natural frequency and damping (3,); the inverse of `values`."""
        gain, natural_frequency, damping = values
        return np.log([gain, 2 * damping / natural_frequency, 0.5 / (damping * natural_frequency)])

    def initial_guesses(self, gain: float, frequency: float) -> list[FloatArray]:
        """Return parameters (3,) of a double pole at `frequency` [rad/s]."""
        return [self.parameters(np.array([gain, frequency, 1.0]))]

    def matrices(self, parameters: AnyArray) -> tuple[AnyArray, AnyArray, AnyArray]:
        """Compute the matrices of the realisation of `TwoPoles`."""
        return self.file.realisation(self.values(parameters))

    def recentred(self, parameters: FloatArray) -> tuple[TwoPolesForm, FloatArray]:
        """Return the form unchanged, because logarithms are well scaled for all values."""
        return self, parameters


TWO_POLES = TwoPolesForm()
"""Form with the bounds of the settings."""
