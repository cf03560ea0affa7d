"""Coherence of a log's streams under plausible dynamics of a robot."""

from __future__ import annotations

from itertools import combinations

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.check_settings import CheckSettings
from diffdrive_mpc.models.logs.diagnosis.streams import COMMAND, ENCODERS, Streams, finite_pairs


def coherence(streams: Streams, settings: CheckSettings) -> float:
    """Compute the mean FIT [%] over all pairs of streams; NaN if there is no pair.

    A robot follows its commands with lags and a dead time. Its body turns later and less than its wheels indicate, and
    sensors of one body agree without delay. A wrong sign, unit or clock contradicts these relations, even if a model
    with free gains and dead times fits the data.
    """
    pairs = [
        _pair_fit(streams, first, second, channel, settings)
        for channel in (0, 1)
        for first, second in combinations([COMMAND, *streams.sensors(channel)], 2)
    ]
    finite = [fit for fit in pairs if np.isfinite(fit)]
    return float(np.mean(finite)) if finite else float("nan")


def _pair_fit(streams: Streams, first: str, second: str, channel: int, settings: CheckSettings) -> float:
    """Compute the FIT of `second` from `first` [%], at least 0, with the best plausible lag, dead time and gain."""
    u, y = streams.pair(first, second, channel)
    # A skid-steer robot turns less than its wheels indicate, and later.
    skids = channel == 1 and first in (COMMAND, ENCODERS)
    gains = settings.gain_of_omega if skids else settings.gain_of_v
    lags = settings.lags if first == COMMAND or skids else (0.0,)
    max_shift = round(settings.max_dead_time / streams.dt) if first == COMMAND else 0
    fits = [
        _fit(*finite_pairs(lagged_input, y, shift), gains)
        for lagged_input in (streams.low_pass(u, lag) for lag in lags)
        for shift in range(max_shift + 1)
    ]
    return max((fit for fit in fits if np.isfinite(fit)), default=float("nan"))


def _fit(u: FloatArray, y: FloatArray, gains: tuple[float, float]) -> float:
    """Compute the FIT [%] of y (n,) by an offset plus u (n,) times the best gain within `gains`; at least 0."""
    variance, input_variance = float(np.var(y)) if len(y) else 0.0, float(np.var(u)) if len(u) else 0.0
    if variance == 0 or input_variance == 0:
        return float("nan")
    covariance = float(np.mean((u - u.mean()) * (y - y.mean())))
    gain = float(np.clip(covariance / input_variance, *gains))
    residual = max(variance - 2 * gain * covariance + gain**2 * input_variance, 0.0)
    return max(100.0 * (1 - float(np.sqrt(residual / variance))), 0.0)
