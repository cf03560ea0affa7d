"""At what times a path is looked at, to be sent or drawn."""

from __future__ import annotations

import numpy as np

from diffdrive_mpc.models.interface import FloatArray

_RATE, _MOST = 20, 500
"""Poses a second, and in all: more only cost time to send and to draw."""


def path_times(duration: float) -> FloatArray:
    """(n,) times [s] from 0 to `duration`."""
    return np.linspace(0.0, duration, min(_MOST, 2 + int(duration * _RATE)))
