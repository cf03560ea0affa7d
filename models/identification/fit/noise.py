"""Noise of the readings of a log."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.record import Record

# Nine tenths of normal values lie within 1.645 standard deviations. The median would be zero for plateaus of counted
# pulses.
_SHARE, _WITHIN = 0.9, 1.645
# Standard deviation of x[k-1] - 2 x[k] + x[k+1] over that of x: linear changes cancel.
SECOND_DIFFERENCE = np.sqrt(6.0)
MIN_READINGS = 50


def sensor_noise(records: Sequence[Record]) -> dict[str, float]:
    """Estimate the standard deviation of the noise of each sensor, by key of the group `estimator`.

    The estimate uses quantiles of second differences of neighbouring readings, which are robust against outliers and
    free of steady motion. Sensors with too few readings have no entry. Units: m/s, rad/s, m, rad.
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
        if second.size >= MIN_READINGS
    }


def second_differences(record: Record, signal: str, columns: list[int]) -> FloatArray:
    """Return the second differences (n,) of equally spaced readings, all columns flattened."""
    fresh = record.fresh(signal)
    if fresh is None:
        return np.empty(0)
    (indices,) = np.nonzero(fresh)
    even = np.diff(indices[:-1]) == np.diff(indices[1:])
    return np.asarray(
        np.diff(getattr(record, signal).reshape(len(fresh), -1)[indices][:, columns], n=2, axis=0)[even].ravel()
    )
