"""Short windows of a log with a measured pose at both ends."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np

from diffdrive_mpc.models.identification.settings import load_settings
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.record import Record
from diffdrive_mpc.models.pose import wrap_angle

_FEWEST_WINDOWS = 20


class PoseWindows(NamedTuple):
    """n windows of one record, W steps each."""

    dt: float
    """Sample time [s]."""
    signal: FloatArray
    """(n, W, c) mean of the signal over each step."""
    displacement: FloatArray
    """(n, 3) motion of the pose point seen from the window's first pose: ahead [m], to the left [m], turned [rad]."""


def pose_windows(
    records: Sequence[Record], signal: Literal["wheels", "yaw_rate"], pose_lag: float = 0.0
) -> list[PoseWindows]:
    """Windows of the settings' length, none overlapping, in which the signal is known throughout.

    Parameters
    ----------
    records
        Records with a pose.
    signal
        What to cut out beside the poses.
    pose_lag
        By how much poses describe the robot earlier than their stamp says, against the signal [s].

    Raises
    ------
    ValueError
        If a record has no pose or no such signal, or there are too few windows in all.
    """
    found = [_of_record(record, signal, pose_lag) for record in records]
    count = sum(len(windows.displacement) for windows in found)
    if count < _FEWEST_WINDOWS:
        raise ValueError(f"{count} windows with a pose at both ends; a calibration needs {_FEWEST_WINDOWS}: longer log")
    return [windows for windows in found if len(windows.displacement)]


def _of_record(record: Record, name: Literal["wheels", "yaw_rate"], pose_lag: float) -> PoseWindows:
    value, pose, fresh = getattr(record, name), record.pose, record.fresh_pose
    if value is None or pose is None or fresh is None:
        raise ValueError(f"record '{record.name}': a calibration from poses needs pose and {name}")
    signal = np.asarray(value).reshape(len(value), -1)
    mean = 0.5 * (signal[1:] + signal[:-1])
    steps, lag = round(load_settings().pose_window / record.dt), round(pose_lag / record.dt)
    starts, k = [], max(lag, 0)
    while k + steps < len(pose) and k + steps - lag < len(signal):
        if fresh[k] and fresh[k + steps] and np.isfinite(mean[k - lag : k - lag + steps]).all():
            starts.append(k)
            k += steps
        else:
            k += 1
    rows = np.array(starts, dtype=np.int64)
    cut = mean[rows[:, None] - lag + np.arange(steps)]
    first, last = pose[rows], pose[rows + steps]
    c, s = np.cos(first[:, 2]), np.sin(first[:, 2])
    x, y, turned = (last - first).T
    return PoseWindows(record.dt, cut, np.column_stack([c * x + s * y, c * y - s * x, wrap_angle(turned)]))
