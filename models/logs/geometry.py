"""Estimation of the wheel radius and the tracks of a robot from wheel speeds, twists and gyro."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.record import Record


class WheelGeometry(NamedTuple):
    """Geometry that converts a log's wheel speeds to v and omega."""

    radius: float
    """Wheel radius [m]."""
    track: float
    """Track [m]."""


def wheel_geometry(records: Sequence[Record]) -> WheelGeometry | None:
    """Fit radius and track by least squares over all records with wheels and twist; None if undetermined.

    v = radius (right + left) / 2, omega = radius (right - left) / track.
    """
    wheels, twist = _readings(records)
    mean, difference = wheels.mean(axis=1), wheels[:, 1] - wheels[:, 0]
    forward, turning = float(mean @ twist[:, 0]), float(difference @ twist[:, 1])
    if forward <= 0 or turning <= 0:
        return None
    radius = forward / float(mean @ mean)
    return WheelGeometry(radius, radius * float(difference @ difference) / turning)


def firmware_track(records: Sequence[Record], geometry: WheelGeometry, dc_gain: FloatArray) -> float | None:
    """Estimate the track [m] by which the firmware converts omega to wheel speeds; return None if it is undetermined.

    The effective track of the body is the difference of rim speeds over the yaw rate of the gyro. The track of the
    firmware is the effective track times the steady yaw gain of the model over its steady forward gain.

    Parameters
    ----------
    records
        Records with wheels and gyro; without a gyro, omega of the model must be that of the wheels.
    geometry
        Geometry of the log's robot.
    dc_gain
        (2, 2) steady gains of the model.
    """
    pairs = [
        np.column_stack([record.twist[:, 1], record.yaw_rate])
        for record in records
        if record.twist is not None and record.yaw_rate is not None
    ]
    effective = geometry.track
    if pairs:
        both = np.concatenate(pairs)
        both = both[np.isfinite(both).all(axis=1)]
        # Subtract the means, so that the bias of the gyro has no effect.
        wheel_rate, yaw_rate = (both - both.mean(axis=0)).T if len(both) else both.T
        product = float(wheel_rate @ yaw_rate)
        if product <= 0:
            return None
        effective *= float(wheel_rate @ wheel_rate) / product
    return float(effective * dc_gain[1, 1] / dc_gain[0, 0])


def _readings(records: Sequence[Record]) -> tuple[FloatArray, FloatArray]:
    wheels, twist = [np.empty((0, 2))], [np.empty((0, 2))]
    for record in records:
        if record.wheels is not None and record.twist is not None and record.fresh_twist is not None:
            wheels.append(record.wheels[record.fresh_twist])
            twist.append(record.twist[record.fresh_twist])
    return np.concatenate(wheels), np.concatenate(twist)
