"""Commands as a base with limits carries them out: a limit on one side is no wrong unit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from diffdrive_mpc.models.base_effects import KINDS, limited
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.check_settings import CheckSettings
from diffdrive_mpc.models.logs.diagnosis.streams import COMMAND, Streams, fit_response

_PARTS = np.geomspace(0.03, 0.8, 10)
"""Levels, as parts of the largest command, and rates, as parts of twice that per second."""
_GROUPS = np.array([[1, 1, 0, 0], [0, 0, 1, 1], *np.eye(len(KINDS))], dtype=bool)
"""Limits that are tried together, in this order."""


def within_limits(streams: Streams, channel: int, settings: CheckSettings) -> Streams:
    """Return the streams with the limited command that explains the sensors of a channel best.

    They are as they were if a limit does not clearly lower the variance that the command leaves unexplained.
    """
    command = streams.command[:, channel]
    above, below = (np.maximum([np.nanmax(command), -np.nanmin(command)], 1e-9)).tolist()
    sizes = np.array([above, below, 2.0 * max(above, below), 2.0 * max(above, below)])
    before = _unexplained(streams, channel, settings)
    best = before, np.full(len(KINDS), np.inf)
    for kinds in _GROUPS:
        candidates = [np.where(kinds, part * sizes, best[1]) for part in _PARTS]
        trials = [(_unexplained(_limited(streams, channel, limit), channel, settings), limit) for limit in candidates]
        best = min([best, *trials], key=lambda trial: trial[0])
    return _limited(streams, channel, best[1]) if best[0] < settings.clipped_rest * before else streams


def _limited(streams: Streams, channel: int, limit: FloatArray) -> Streams:
    command = streams.command.copy()
    for part in streams.slices:
        rows = command[part, channel : channel + 1]
        if np.isfinite(rows).all():
            command[part, channel : channel + 1] = limited(rows, limit[None], streams.dt, rows[0])
    return replace(streams, command=command)


def _unexplained(streams: Streams, channel: int, settings: CheckSettings) -> float:
    """Return the share of the variance of the sensors that the command leaves unexplained, its mean."""
    answers = [
        fit_response(streams, *streams.pair(COMMAND, name, channel), settings) for name in streams.present(channel)
    ]
    shares = [1 - float(response.correlation[0]) ** 2 for response in answers if response is not None]
    return float(np.mean(shares)) if shares else 0.0
