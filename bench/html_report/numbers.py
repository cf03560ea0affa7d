"""Numbers of charts: rounded, and no more of them than can be seen."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from diffdrive_mpc.models.interface import FloatArray

_TAIL_POINTS = 120


def from_zero(time: FloatArray) -> tuple[FloatArray, str]:
    """Times (n,) [s] counted from the first, and the title of their axis, which names the first."""
    begin = float(time[0]) if len(time) else 0.0
    since = f" since {begin:.2f} s on the log's clock" if begin else ""
    return time - begin, f"time [s]{since}"


def rounded(value: float) -> float | None:
    """A number with four leading digits; None where it could not be computed."""
    return float(f"{value:.4g}") if math.isfinite(value) else None


def tail(values: Sequence[float] | FloatArray) -> tuple[list[float], list[float | None]]:
    """Values, and the share that is larger: some, evenly over the logarithm of that share, as the tail matters."""
    ordered = np.sort(np.asarray(values, dtype=float))
    kept = np.unique(ordered.size - np.geomspace(1, ordered.size, _TAIL_POINTS).round().astype(int))
    return [float(f"{one:.4g}") for one in ordered[kept]], [rounded(1.0 - k / ordered.size) for k in kept]
