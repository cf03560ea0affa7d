"""Coherence of a log's streams under the dynamics that a robot may have."""

from __future__ import annotations

from itertools import combinations

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.check_settings import CheckSettings
from diffdrive_mpc.models.logs.diagnosis.streams import COMMAND, ENCODERS, Streams, paired


def coherence(streams: Streams, settings: CheckSettings) -> float:
    """Compute the mean FIT of one stream from another over all pairs [%]; NaN without a pair.

    A robot follows its commands with lags and a dead time, its body turns after its wheels and less than they indicate,
    and sensors of one body agree at once. A wrong sign, unit or clock has none of these forms, even if a model with
    free gains and dead times can fit it.
    """
    pairs = [
        _explained(streams, first, second, channel, settings)
        for channel in (0, 1)
        for first, second in combinations([COMMAND, *streams.present(channel)], 2)
    ]
    known = [pair for pair in pairs if np.isfinite(pair)]
    return float(np.mean(known)) if known else float("nan")


def _explained(streams: Streams, first: str, second: str, channel: int, settings: CheckSettings) -> float:
    """Compute the FIT of `second` from `first` [%], at least 0, at the best lag, dead time and gain of a robot."""
    u, y = streams.pair(first, second, channel)
    skids = channel == 1 and first in (COMMAND, ENCODERS)
    gains = settings.gain_of_omega if skids else settings.gain_of_v
    lags = settings.lags if first == COMMAND or skids else (0.0,)
    latest = round(settings.longest_lag / streams.dt) if first == COMMAND else 0
    fits = [
        _fit(*paired(behind, y, shift), gains)
        for behind in (streams.lagged(u, lag) for lag in lags)
        for shift in range(latest + 1)
    ]
    known = [fit for fit in fits if np.isfinite(fit)]
    return max(known, default=float("nan"))


def _fit(u: FloatArray, y: FloatArray, gains: tuple[float, float]) -> float:
    """Compute the FIT of y (n,) by an offset and a gain within `gains` times u (n,) [%], at least 0."""
    spread, drive = float(np.var(y)) if len(y) else 0.0, float(np.var(u)) if len(u) else 0.0
    if spread == 0 or drive == 0:
        return float("nan")
    together = float(np.mean((u - u.mean()) * (y - y.mean())))
    gain = float(np.clip(together / drive, *gains))
    rest = max(spread - 2 * gain * together + gain**2 * drive, 0.0)
    return max(100.0 * (1 - float(np.sqrt(rest / spread))), 0.0)
