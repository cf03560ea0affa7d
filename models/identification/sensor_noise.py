"""How far the readings of a log scatter from one to the next."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.record import BoolArray, Record

# Nine tenths of normal values are within so many standard deviations. Plateaus of counted pulses make the median zero.
_SHARE, _WITHIN = 0.9, 1.645
# Standard deviation of x[k-1] - 2 x[k] + x[k+1] over that of x: what changes evenly has no part in it.
_SECOND_DIFFERENCE = np.sqrt(6.0)
_FEWEST = 50


def sensor_noise(records: Sequence[Record]) -> dict[str, float]:
    """Standard deviation of what is random in the readings, by the name of its key in the group `estimator`.

    From second differences of neighbouring readings, so outliers and steady motion do not count. Sensors without enough
    readings have no entry. Units: m/s, rad/s, m, rad.
    """
    found = {
        "wheel_speed_noise": [_scatter(one.twist, one.fresh_twist, [0]) for one in records],
        "wheel_yaw_rate_noise": [_scatter(one.twist, one.fresh_twist, [1]) for one in records],
        "yaw_rate_noise": [_scatter(one.yaw_rate, one.fresh_yaw_rate, [0]) for one in records],
        "position_noise": [_scatter(one.pose, one.fresh_pose, [0, 1]) for one in records],
        "heading_noise": [_scatter(one.pose, one.fresh_pose, [2]) for one in records],
    }
    joined = {name: np.concatenate(parts) for name, parts in found.items()}
    return {
        name: float(np.quantile(np.abs(second), _SHARE) / (_WITHIN * _SECOND_DIFFERENCE))
        for name, second in joined.items()
        if second.size >= _FEWEST
    }


def _scatter(signal: FloatArray | None, fresh: BoolArray | None, columns: list[int]) -> FloatArray:
    """Second differences of readings that are equally far apart."""
    if signal is None or fresh is None:
        return np.empty(0)
    (at,) = np.nonzero(fresh)
    even = np.diff(at[:-1]) == np.diff(at[1:])
    return np.asarray(np.diff(signal.reshape(len(signal), -1)[at][:, columns], n=2, axis=0)[even].ravel())
