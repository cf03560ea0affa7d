"""Statistics of drawn runs with bootstrap intervals."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import DegenerateDataWarning, bootstrap

from diffdrive_mpc.models.interface import FloatArray

CONFIDENCE = 0.95
TAIL = 0.05
"""Share of the worst runs that CVaR is the mean of."""
_RESAMPLES = 2000
_SEED = 17


@dataclass(frozen=True)
class BootstrapEstimate:
    """A figure over runs with its bootstrap interval (percentiles)."""

    value: float
    low: float
    high: float

    @classmethod
    def of_runs(cls, values: ArrayLike, figure: Callable[..., FloatArray]) -> BootstrapEstimate:
        """Return `figure(values, axis=-1)` of (n,) values; NaN without any, its interval with fewer than two."""
        sample = np.asarray(values, dtype=float)
        if sample.size == 0:
            return cls(np.nan, np.nan, np.nan)
        value = float(figure(sample, axis=-1))
        if sample.size < 2 or np.ptp(sample) == 0.0:
            same = value if sample.size > 1 else np.nan
            return cls(value, same, same)
        interval = bootstrap(
            (sample,),
            figure,
            n_resamples=_RESAMPLES,
            batch=100,
            confidence_level=CONFIDENCE,
            method="percentile",
            random_state=np.random.default_rng(_SEED),
        ).confidence_interval
        return cls(value, float(interval.low), float(interval.high))

    @classmethod
    def of_same_runs(cls, tables: Sequence[FloatArray], figure: Callable[..., FloatArray]) -> BootstrapEstimate:
        """Return `figure(*tables)` of tables (..., n) of the same n runs, drawn together along the last axis."""

        def drawn(runs: ArrayLike, axis: int = -1) -> FloatArray:
            return figure(*(table[..., np.moveaxis(np.asarray(runs), axis, -1).astype(int)] for table in tables))

        with warnings.catch_warnings():
            # Tables that are the same have an interval without width.
            warnings.simplefilter("ignore", DegenerateDataWarning)
            return cls.of_runs(np.arange(tables[0].shape[-1], dtype=float), drawn)


def mean(values: FloatArray, axis: int = -1) -> FloatArray:
    """Return the mean along an axis."""
    return np.asarray(np.mean(values, axis=axis))


def median(values: FloatArray, axis: int = -1) -> FloatArray:
    """Return the median along an axis."""
    return np.asarray(np.median(values, axis=axis))


def cvar(values: ArrayLike, axis: int = -1) -> FloatArray:
    """Return the conditional value at risk: the mean of the worst twentieth along an axis.

    Where a twentieth of n is no whole number, the last of the worst counts by the part that is left (Rockafellar,
    Uryasev, J. Banking & Finance 26, 2002, for a sample).
    """
    worst = -np.sort(-np.moveaxis(np.asarray(values, dtype=float), axis, -1), axis=-1)
    mass = max(TAIL * worst.shape[-1], np.finfo(float).tiny)
    weights = np.clip(mass - np.arange(worst.shape[-1]), 0.0, 1.0)
    return np.asarray(worst @ (weights / weights.sum()))
