"""Errors of a simulation in blocks of time, which FIT and its uncertainty come from."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from diffdrive_mpc.models.identification.settings import identification_settings
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.output_error.experiment import SampledExperiment

_DRAWS, _SEED = 2000, 0
INTERVAL = (0.025, 0.975)
"""Of 95 %, as quantiles."""


def block_powers(
    measured: Sequence[SampledExperiment], simulated: Sequence[FloatArray]
) -> tuple[FloatArray, FloatArray]:
    """(B, 2) mean square errors of v [m/s] and omega [rad/s] in blocks of time, and the readings behind each.

    Errors within a block follow from one another; those of different blocks hardly do.
    """
    length = identification_settings().block_time
    powers, weights = [], []
    for experiment, output in zip(measured, simulated, strict=True):
        errors = experiment.readings - output
        span = max(1, round(length / experiment.dt))
        for first in range(0, len(errors), span):
            block = errors[first : first + span]
            count = np.isfinite(block).sum(axis=0)
            if count.all():
                powers.append(np.nanmean(block**2, axis=0))
                weights.append(count)
    return np.array(powers).reshape(-1, 2), np.array(weights, dtype=float).reshape(-1, 2)


def pooled_fit(
    powers: FloatArray, weights: FloatArray, spread: FloatArray, draws: FloatArray | None = None
) -> FloatArray:
    """(..., 2) FIT of v and omega over all blocks [%]; of blocks that are drawn (..., B) so often.

    Parameters
    ----------
    powers, weights
        (B, 2) of `block_powers`.
    spread
        (2,) variance of what was measured, about its mean.
    draws
        How often each block counts; once by default.
    """
    drawn = np.ones(len(weights)) if draws is None else draws
    power = drawn @ (weights * powers)
    return np.asarray(100.0 * (1.0 - np.sqrt(power / (drawn @ weights) / spread)))


def drawn_blocks(count: int) -> FloatArray:
    """(draws, count) how often each of `count` blocks is drawn, with one seed: for the spread of a statistic."""
    rng = np.random.default_rng(_SEED)
    return rng.multinomial(count, np.full(count, 1.0 / count), size=_DRAWS).astype(float)
