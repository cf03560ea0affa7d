"""Statistics of runs with bootstrap intervals."""

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
"""Share of the worst runs in the conditional value at risk (CVaR) [-]."""
_RESAMPLES = 2000
_SEED = 17


@dataclass(frozen=True)
class BootstrapEstimate:
    """Statistic of runs with its percentile bootstrap interval."""

    value: float
    low: float
    high: float

    @classmethod
    def of_runs(cls, values: ArrayLike, statistic: Callable[..., FloatArray]) -> BootstrapEstimate:
        """Estimate `statistic(values, axis=-1)` of values (n,); NaN for n = 0, and interval NaN for n = 1."""
        sample = np.asarray(values, dtype=float)
        if sample.size == 0:
            return cls(np.nan, np.nan, np.nan)
        value = float(statistic(sample, axis=-1))
        if sample.size < 2 or np.ptp(sample) == 0.0:
            end = value if sample.size > 1 else np.nan
            return cls(value, end, end)
        interval = bootstrap(
            (sample,),
            statistic,
            n_resamples=_RESAMPLES,
            batch=100,
            confidence_level=CONFIDENCE,
            method="percentile",
            random_state=np.random.default_rng(_SEED),
        ).confidence_interval
        return cls(value, float(interval.low), float(interval.high))

    @classmethod
    def of_same_runs(cls, tables: Sequence[FloatArray], statistic: Callable[..., FloatArray]) -> BootstrapEstimate:
        """Estimate `statistic(*tables)` of tables (..., n) of n runs, resampled jointly along the last axis."""

        def joint_statistic(runs: ArrayLike, axis: int = -1) -> FloatArray:
            return statistic(*(table[..., np.moveaxis(np.asarray(runs), axis, -1).astype(int)] for table in tables))

        with warnings.catch_warnings():
            # Equal tables have an interval of width zero.
            warnings.simplefilter("ignore", DegenerateDataWarning)
            return cls.of_runs(np.arange(tables[0].shape[-1], dtype=float), joint_statistic)


def mean(values: FloatArray, axis: int = -1) -> FloatArray:
    """Return the mean along an axis."""
    return np.asarray(np.mean(values, axis=axis))


def median(values: FloatArray, axis: int = -1) -> FloatArray:
    """Return the median along an axis."""
    return np.asarray(np.median(values, axis=axis))


def cvar(values: ArrayLike, axis: int = -1) -> FloatArray:
    """Return the conditional value at risk: the mean of the largest 5 % along an axis.

    If 5 % of n is not an integer, the last value has a fractional weight (Rockafellar, Uryasev, J. Banking & Finance
    26, 2002).
    """
    descending = -np.sort(-np.moveaxis(np.asarray(values, dtype=float), axis, -1), axis=-1)
    count = max(TAIL * descending.shape[-1], np.finfo(float).tiny)
    weights = np.clip(count - np.arange(descending.shape[-1]), 0.0, 1.0)
    return np.asarray(descending @ (weights / weights.sum()))
