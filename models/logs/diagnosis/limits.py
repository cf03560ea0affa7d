"""Estimation of the limits of a base, because a limit of a command otherwise appears as a wrong unit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from diffdrive_mpc.models.base_effects import KINDS, apply_limits
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.check_settings import CheckSettings
from diffdrive_mpc.models.logs.diagnosis.streams import Streams

_SHARES = np.geomspace(0.03, 0.8, 10)
"""Candidate limits: levels as shares of the maximum command, rates as shares of twice the maximum per second."""
_GROUPS = np.array([[1, 1, 0, 0], [0, 0, 1, 1], *np.eye(len(KINDS))], dtype=bool)
"""Groups of `KINDS` of limits that are varied together, in the order of the search."""


def apply_best_limits(streams: Streams, channel: int, settings: CheckSettings) -> Streams:
    """Apply the limits to the command of a channel that explain its sensors best.

    The streams are returned unchanged if limits do not clearly reduce the residual variance.
    """
    command = streams.command[:, channel]
    above, below = (np.maximum([np.nanmax(command), -np.nanmin(command)], 1e-9)).tolist()
    sizes = np.array([above, below, 2.0 * max(above, below), 2.0 * max(above, below)])
    before = _residual_share(streams, channel, settings)
    best = before, np.full(len(KINDS), np.inf)
    for kinds in _GROUPS:
        candidates = [np.where(kinds, share * sizes, best[1]) for share in _SHARES]
        trials = [
            (_residual_share(_with_limit(streams, channel, limit), channel, settings), limit) for limit in candidates
        ]
        best = min([best, *trials], key=lambda trial: trial[0])
    return _with_limit(streams, channel, best[1]) if best[0] < settings.clipped_residual * before else streams


def _with_limit(streams: Streams, channel: int, limit: FloatArray) -> Streams:
    command = streams.command.copy()
    for part in streams.slices:
        rows = command[part, channel : channel + 1]
        if np.isfinite(rows).all():
            command[part, channel : channel + 1] = apply_limits(rows, limit[None], streams.dt, rows[0])
    return replace(streams, command=command)


def _residual_share(streams: Streams, channel: int, settings: CheckSettings) -> float:
    """Return the mean share of the sensors' variance that the command does not explain."""
    responses = streams.command_responses(channel, settings).values()
    shares = [1 - float(response.correlation[0]) ** 2 for response in responses]
    return float(np.mean(shares)) if shares else 0.0
