"""Odometry pose of a base from wheels and gyro, optionally with a pose sensor."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import ArrayLike

from diffdrive_mpc.models.interface import FloatArray, Measurement
from diffdrive_mpc.models.pose import integrate_pose


class Odometry:
    """Integrator of v of the wheels and yaw rate of the gyro, with optional corrections by a pose sensor.

    Parameters
    ----------
    pose
        (3,) start pose x [m], y [m], theta [rad], at which odom and map coincide.
    memory
        Maximum latency of the pose sensor in ticks.
    use_pose_sensor
        True to propagate the newest pose of the sensor; otherwise poses are not used.
    """

    def __init__(self, pose: ArrayLike, memory: int, *, use_pose_sensor: bool) -> None:
        start = np.array(pose, dtype=float)
        self._accumulated = start
        self._twist = np.zeros(2)
        self._time = 0.0
        self._past: deque[tuple[float, FloatArray]] = deque([(0.0, start)], maxlen=memory + 2)
        self._use_pose_sensor = use_pose_sensor
        self._sensed, self._anchor = start, start

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
            twist[0] = np.asarray(measurement.wheel_twist.value)[0]
        if measurement.yaw_rate is not None:
            twist[1] = measurement.yaw_rate.value
        mean = 0.5 * (self._twist + twist)
        self._accumulated = integrate_pose(self._accumulated, mean[0], mean[1], time - self._time)
        self._time, self._twist = time, twist
        self._past.append((time, self._accumulated))
        if not self._use_pose_sensor:
            return self._accumulated
        if measurement.pose is not None:
            self._sensed = np.asarray(measurement.pose.value, dtype=float)
            self._anchor = self._accumulated_at(measurement.pose.time)
        return _transform(self._sensed, self._anchor, self._accumulated)

    def _accumulated_at(self, time: float) -> FloatArray:
        """Compute the accumulated pose (3,) at a past time [s]; before the start, the robot was at rest."""
        times = np.array([past_time for past_time, _ in self._past])
        poses = np.array([pose for _, pose in self._past])
        return np.array([np.interp(time, times, poses[:, i]) for i in range(3)])


def _transform(pose: FloatArray, before: FloatArray, after: FloatArray) -> FloatArray:
    """Apply the rigid motion from `before` to `after` to `pose` (3,)."""
    turn = pose[2] - before[2]
    c, s = np.cos(turn), np.sin(turn)
    x, y = after[:2] - before[:2]
    return np.array([pose[0] + c * x - s * y, pose[1] + s * x + c * y, after[2] + turn])
