"""Every measured channel beside the command that it should answer to."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.record import Record


@dataclass(frozen=True)
class Response:
    """One measured channel over several records.

    Attributes
    ----------
    sensor
        "encoders", "gyro" or "pose".
    channel
        0 for v, 1 for omega.
    measured
        One (K,) array per record in SI units; NaN where there is no reading.
    """

    sensor: str
    channel: int
    measured: tuple[FloatArray, ...]


def largest_command(records: Sequence[Record]) -> FloatArray:
    """(2,) largest |v| [m/s] and |omega| [rad/s] that are commanded anywhere."""
    return np.asarray(np.max([np.abs(record.command).max(axis=0) for record in records], axis=0))


def responses(records: Sequence[Record], pose_window: float) -> list[Response]:
    """All channels that the records hold; the pose's as its mean speeds over `pose_window` [s]."""
    found = []
    for channel in (0, 1):
        if all(record.twist is not None for record in records):
            found.append(Response("encoders", channel, tuple(_twist(record)[:, channel] for record in records)))
        if channel == 1 and all(record.yaw_rate is not None for record in records):
            found.append(Response("gyro", channel, tuple(_yaw_rate(record) for record in records)))
        if all(record.pose is not None for record in records):
            speeds = tuple(pose_speeds(record, pose_window)[:, channel] for record in records)
            found.append(Response("pose", channel, speeds))
    return found


def pose_speeds(record: Record, window: float) -> FloatArray:
    """(K, 2) v [m/s] and omega [rad/s] of the pose, as central differences over `window` [s]; NaN at the ends."""
    assert record.pose is not None
    reach = max(1, round(0.5 * window / record.dt))
    speeds = np.full((len(record.pose), 2), np.nan)
    if len(record.pose) > 2 * reach:
        dx, dy, turn = (record.pose[2 * reach :] - record.pose[: -2 * reach]).T / (2 * reach * record.dt)
        theta = record.pose[reach:-reach, 2]
        speeds[reach:-reach] = np.column_stack([np.cos(theta) * dx + np.sin(theta) * dy, turn])
    return speeds


def _twist(record: Record) -> FloatArray:
    assert record.twist is not None and record.fresh_twist is not None
    return np.where(record.fresh_twist[:, None], record.twist, np.nan)


def _yaw_rate(record: Record) -> FloatArray:
    assert record.yaw_rate is not None and record.fresh_yaw_rate is not None
    return np.where(record.fresh_yaw_rate, record.yaw_rate, np.nan)
