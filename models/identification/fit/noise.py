"""Noise of the readings of a log."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.record import Record

# 90 % of normally distributed values are within 1.645 standard deviations. The quantile is larger than the median,
# which may be zero, because counts of encoder pulses have plateaus.
_SHARE, _DEVIATIONS = 0.9, 1.645
# Ratio of the standard deviations of x[k-1] - 2 x[k] + x[k+1] and x for white noise; linear changes cancel.
SECOND_DIFFERENCE = np.sqrt(6.0)
MIN_READINGS = 50


def sensor_noise(records: Sequence[Record]) -> dict[str, float]:
    """Estimate the standard deviation of the noise of each sensor, by key of the group `estimator`.

    The estimate uses quantiles, which are robust against outliers, of the second differences of neighbouring readings,
    which do not contain steady motion. Sensors with too few readings are omitted. Units: m/s, rad/s, m, rad.
    """
    sources = {
        "wheel_speed_noise": ("twist", [0]),
        "wheel_yaw_rate_noise": ("twist", [1]),
        "yaw_rate_noise": ("yaw_rate", [0]),
        "position_noise": ("pose", [0, 1]),
        "heading_noise": ("pose", [2]),
    }
    differences_by_sensor = {
        name: np.concatenate([second_differences(record, signal, columns) for record in records])
        for name, (signal, columns) in sources.items()
    }
    return {
        name: float(np.quantile(np.abs(differences), _SHARE) / (_DEVIATIONS * SECOND_DIFFERENCE))
        for name, differences in differences_by_sensor.items()
        if differences.size >= MIN_READINGS
    }


def second_differences(record: Record, signal: str, columns: list[int]) -> FloatArray:
    """Compute the second differences (n,) of equally spaced readings of all columns."""
    fresh = record.fresh(signal)
    if fresh is None:
        return np.empty(0)
    (indices,) = np.nonzero(fresh)
    is_equally_spaced = np.diff(indices[:-1]) == np.diff(indices[1:])
    readings = getattr(record, signal).reshape(len(fresh), -1)[indices][:, columns]
    return np.asarray(np.diff(readings, n=2, axis=0)[is_equally_spaced].ravel())
