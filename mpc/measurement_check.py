"""Turn whatever arrives into checked numbers, or into nothing."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from diffdrive_mpc.models.interface import FloatArray

# A variance of a square kilometre says nothing about a robot, and would overflow the filter before long.
_LARGEST_VARIANCE = 1e6
# Share by which two mirrored entries may differ: rounding on the way here.
_ASYMMETRY = 1e-6
# Clocks of one robot agree to better than this; a stamp further ahead of the tick is a fault [s].
_FUTURE = 1e-3


def numbers(value: Any, count: int) -> FloatArray | None:  # noqa: ANN401 - whatever arrives
    """`value` as `count` finite numbers, or None if it is anything else."""
    try:
        array = np.asarray(value, dtype=float).ravel()
    except (TypeError, ValueError, OverflowError):
        return None
    return array if len(array) == count and bool(np.isfinite(array).all()) else None


def covariance(value: ArrayLike, size: int) -> FloatArray | None:
    """`value` as a symmetric positive definite (size, size) matrix with possible entries, or None."""
    entries = numbers(value, size * size)
    if entries is None or np.abs(entries).max() > _LARGEST_VARIANCE:
        return None
    matrix = entries.reshape(size, size)
    if (np.abs(matrix - matrix.T) > _ASYMMETRY * np.abs(matrix)).any():
        return None
    try:
        np.linalg.cholesky(matrix)
    except np.linalg.LinAlgError:
        return None
    return matrix


def stamp_fault(stamp: object, t: float, last: float, history: float) -> str:
    """What is wrong with a stamp at tick `t` [s], after one at `last` [s]; empty if nothing is."""
    time = numbers(stamp, 1)
    if time is None:
        return "its stamp is not a finite number"
    age = t - float(time[0])
    if age < -_FUTURE:
        return f"its stamp lies {-age:.3f} s in the future"
    if time[0] <= last:
        return "its stamp is not newer than that of the one before"
    if age > history:
        return f"it is {age:.2f} s old; the history reaches back {history} s"
    return ""
