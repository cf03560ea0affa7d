"""Scatter of the readings of a log from one to the next."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.record import Record

# Number of standard deviations that contain nine tenths of normal values. Plateaus of counted pulses make the median
# zero.
_SHARE, _WITHIN = 0.9, 1.645
# Standard deviation of x[k-1] - 2 x[k] + x[k+1] over that of x: linear changes cancel.
SECOND_DIFFERENCE = np.sqrt(6.0)
FEWEST = 50


def sensor_noise(records: Sequence[Record]) -> dict[str, float]:
    """Estimate the standard deviation of the random part of readings, by the key in the group `estimator`.

    From second differences of neighbouring readings, so outliers and steady motion do not count. Sensors without enough
    readings have no entry. Units: m/s, rad/s, m, rad.
    """
    sources = {
        "wheel_speed_noise": ("twist", [0]),
        "wheel_yaw_rate_noise": ("twist", [1]),
        "yaw_rate_noise": ("yaw_rate", [0]),
        "position_noise": ("pose", [0, 1]),
        "heading_noise": ("pose", [2]),
    }
    joined = {
        name: np.concatenate([second_differences(record, signal, columns) for record in records])
        for name, (signal, columns) in sources.items()
    }
    return {
        name: float(np.quantile(np.abs(second), _SHARE) / (_WITHIN * SECOND_DIFFERENCE))
        for name, second in joined.items()
        if second.size >= FEWEST
    }


def second_differences(record: Record, signal: str, columns: list[int]) -> FloatArray:
    """Return second differences (n, columns flattened) of readings that are equally far apart."""
    fresh = record.fresh(signal)
    if fresh is None:
        return np.empty(0)
    (indices,) = np.nonzero(fresh)
    even = np.diff(indices[:-1]) == np.diff(indices[1:])
    return np.asarray(
        np.diff(getattr(record, signal).reshape(len(fresh), -1)[indices][:, columns], n=2, axis=0)[even].ravel()
    )
