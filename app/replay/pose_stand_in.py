"""Poses for a log without any: dead reckoning by wheels and gyro. It drifts, and cannot tell the place."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from diffdrive_mpc.app.replay.assembly import Readings
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.pose import integrate_pose

STAND_IN = (
    "Poses are a stand-in: dead reckoning by wheels and gyro from (0, 0, 0). It drifts and cannot show side-slip, so "
    "errors of position and what the estimator says of poses mean nothing; dead time, limits and speeds do."
)


def by_odometry(readings: Mapping[str, Readings], log: str) -> Readings:
    """Poses at the readings of the wheels, turned by the gyro where there is one; raises ConfigError without wheels."""
    wheels, gyro = readings.get("wheel_twist"), readings.get("yaw_rate")
    if wheels is None or len(wheels.stamp) < 2:
        raise ConfigError(f"{log}: --pose odometry needs wheel speeds, and the log has none; map them")
    v, omega = wheels.value.T
    if gyro is not None:
        omega = np.interp(wheels.stamp, gyro.stamp, gyro.value[:, 0])
    steps = np.diff(wheels.stamp)
    pose = np.zeros((len(wheels.stamp), 3))
    for k, dt in enumerate(steps):
        pose[k + 1] = integrate_pose(pose[k], 0.5 * (v[k] + v[k + 1]), 0.5 * (omega[k] + omega[k + 1]), dt)
    return Readings(wheels.arrival, wheels.stamp, pose)
