"""Odometry pose of a base from wheels and gyro, optionally with a pose sensor."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import ArrayLike

from diffdrive_mpc.models.interface import FloatArray, Measurement
from diffdrive_mpc.models.pose import integrate_pose


class Odometry:
    """Dead reckoning with v of the wheels and yaw rate of the gyro, optionally corrected by a pose sensor.

    Parameters
    ----------
    pose
        (3,) start pose x [m], y [m], theta [rad], at which the frames odom and map coincide.
    memory
        Maximum latency of the pose sensor in ticks.
    use_pose_sensor
        True to start from the newest pose of the sensor and integrate the motion since its time; False for pure dead
        reckoning.
    correction
        Ratios of the readings of wheels and gyro to speed and yaw rate, by which readings are divided [-].
    """

    def __init__(
        self, pose: ArrayLike, memory: int, *, use_pose_sensor: bool, correction: tuple[float, float] = (1.0, 1.0)
    ) -> None:
        start = np.array(pose, dtype=float)
        self._integrated = start
        self._twist, self._correction = np.zeros(2), correction
        self._time = 0.0
        self._past: deque[tuple[float, FloatArray]] = deque([(0.0, start)], maxlen=memory + 2)
        self._use_pose_sensor = use_pose_sensor
        self._sensor_pose, self._anchor = start, start

    def update(self, time: float, measurement: Measurement) -> FloatArray:
        """Advance to `time` [s] with the delivered measurements.

        For a sensor without a new reading, the last value is used.

        Returns
        -------
        FloatArray
            (3,) x [m], y [m], theta [rad, unwrapped].
        """
        twist = self._twist.copy()
        if measurement.wheel_twist is not None:
            twist[0] = np.asarray(measurement.wheel_twist.value)[0] / self._correction[0]
        if measurement.yaw_rate is not None:
            twist[1] = np.asarray(measurement.yaw_rate.value) / self._correction[1]
        mean = 0.5 * (self._twist + twist)
        self._integrated = integrate_pose(self._integrated, mean[0], mean[1], time - self._time)
        self._time, self._twist = time, twist
        self._past.append((time, self._integrated))
        if not self._use_pose_sensor:
            return self._integrated
        if measurement.pose is not None:
            self._sensor_pose = np.asarray(measurement.pose.value, dtype=float)
            self._anchor = self._integrated_at(measurement.pose.time)
        return _transform(self._sensor_pose, self._anchor, self._integrated)

    def _integrated_at(self, time: float) -> FloatArray:
        """Interpolate the integrated pose (3,) at a past time [s]; before the start, the robot was at rest."""
        times = np.array([past_time for past_time, _ in self._past])
        poses = np.array([pose for _, pose in self._past])
        return np.array([np.interp(time, times, poses[:, i]) for i in range(3)])


def _transform(pose: FloatArray, start: FloatArray, end: FloatArray) -> FloatArray:
    """Apply the rigid motion from `start` to `end` to `pose` (3,)."""
    rotation = pose[2] - start[2]
    c, s = np.cos(rotation), np.sin(rotation)
    x, y = end[:2] - start[:2]
    return np.array([pose[0] + c * x - s * y, pose[1] + s * x + c * y, end[2] + rotation])
