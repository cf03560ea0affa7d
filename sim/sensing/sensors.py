"""Sensors of all plants, with noise, bias, rate and latency between the true state and the controller."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator

import numpy as np
from numpy.typing import ArrayLike

from diffdrive_mpc.models.interface import FloatArray, Measurement, Stamped
from diffdrive_mpc.models.pose import wrap_angle
from diffdrive_mpc.models.wheels import WheelKinematics
from diffdrive_mpc.sim.sensing.sensor_set import SensorSet

TIME_TOLERANCE = 1e-9
"""Tolerance of times for rounding errors of sums and multiples [s]."""
_BLOCK = 256
"""Number of noise samples that are drawn at once."""


class Sensors:
    """Simulated sensors that convert true motion to measurements.

    The plant reports its motion at each sample, and `collect` returns the delivered measurements. Every sensor has a
    separate random stream, so the rate of a sensor does not change the noise of other sensors.

    Parameters
    ----------
    parameters
        Noise, rates and latencies.
    kinematics
        Kinematics with wheel radius and geometric track, from which the twist of the encoders is computed.
    sample_time
        Control sample time [s].
    seed
        Non-negative seed of the noise.
    noisy_encoders
        True to add white noise to wheel speeds; False if the plant simulates encoder counts.
    """

    def __init__(
        self, parameters: SensorSet, kinematics: WheelKinematics, sample_time: float, *, seed: int, noisy_encoders: bool
    ) -> None:
        self._parameters = parameters
        self._kinematics = kinematics
        self._period = parameters.pose.period or sample_time
        self._seed = seed
        pose, gyro, speed_sd = parameters.pose, parameters.gyro, parameters.encoders.speed_sd
        self._pose_sd = np.array([pose.position_sd, pose.position_sd, pose.heading_sd])
        self._speed_noise = speed_sd if noisy_encoders else 0.0
        to_body = kinematics.wheels_to_body
        stated_sd = self._pose_sd.copy()
        if pose.stated_position_sd is not None:
            stated_sd[:2] = pose.stated_position_sd
        self._pose_covariance = _published_covariance(np.diag(stated_sd**2))
        self._pose_signs = np.array([1.0, -1.0 if pose.mirrored else 1.0, pose.theta_sign])
        encoders = parameters.encoders
        # The order is front left, front right, rear left, rear right.
        self._wheels = np.array([1, 0, 3, 2] if encoders.swapped else [0, 1, 2, 3])
        self._wheel_signs = np.array([encoders.left, encoders.right] * 2)
        self._gyro_covariance = _published_covariance(np.array([[gyro.noise_sd**2]]))
        self._speed_covariance = _published_covariance(speed_sd**2 * np.eye(4))
        self._twist_covariance = _published_covariance(speed_sd**2 * (to_body @ to_body.T))
        self.reset(np.zeros(3), np.zeros(4))

    def reset(self, pose: ArrayLike, wheel_speeds: ArrayLike) -> None:
        """Restart the noise at time 0 for a robot at rest at `pose` (3,)."""
        pose_noise, gyro_noise, encoder_noise, losses = np.random.SeedSequence(self._seed).spawn(4)
        self._losses = np.random.default_rng(losses)
        self._pose_noise, self._gyro_noise = _white(pose_noise, self._pose_sd), _white(gyro_noise, np.ones(1))
        self._encoder_noise = _white(encoder_noise, np.full(4, self._speed_noise))
        self._gyro_bias = self._parameters.gyro.bias_sd * float(next(self._gyro_noise)[0])
        self._pending_poses: deque[tuple[float, Stamped]] = deque()
        # The first pose is the first that arrives by time 0.
        self._next_pose = -int(np.ceil((self._parameters.pose.latency - TIME_TOLERANCE) / self._period))
        for time in self.poses_due(0.0):
            self.add_pose(time, pose)
        self.add_motion(0.0, wheel_speeds, 0.0)

    def poses_due(self, until: float) -> list[float]:
        """Return the times of pose measurements up to `until` [s]; `add_pose` must be called for each time."""
        due = []
        while self._next_pose * self._period <= until + TIME_TOLERANCE:
            due.append(self._next_pose * self._period)
            self._next_pose += 1
        return due

    def add_pose(self, time: float, pose: ArrayLike) -> None:
        """Measure the true `pose` (3,) at `time` [s] with the pose sensor."""
        sensor = self._parameters.pose
        value = (np.asarray(pose, dtype=float) + next(self._pose_noise)) * self._pose_signs
        value[2] = -wrap_angle(-(value[2] + sensor.turned))  # into (-pi, pi], like SLAM
        loss = self._parameters.pose.loss
        if loss > 0 and self._losses.random() < loss:
            return
        arrival = time + self._parameters.pose.latency
        stamp = arrival if self._parameters.pose.stamped_on_arrival else time
        self._pending_poses.append((arrival, Stamped(value, stamp, self._pose_covariance)))

    def add_motion(self, time: float, wheel_speeds: ArrayLike, yaw_rate: float) -> None:
        """Measure wheel speeds (4,) [rad/s] with encoders and the true yaw rate [rad/s] with the gyro at `time` [s]."""
        gyro = self._parameters.gyro
        speeds = np.asarray(wheel_speeds, dtype=float) + next(self._encoder_noise)
        speeds = speeds[self._wheels] * self._wheel_signs
        noise = self._gyro_bias + gyro.noise_sd * float(next(self._gyro_noise)[0])
        rate = min(max(gyro.scale * yaw_rate + noise, -gyro.largest), gyro.largest)
        self._wheel_speeds: Stamped | None = Stamped(speeds, time, self._speed_covariance)
        self._wheel_twist: Stamped | None = Stamped(self._kinematics.twist(speeds), time, self._twist_covariance)
        self._yaw_rate: Stamped | None = Stamped(np.float64(rate), time, self._gyro_covariance)

    def collect(self, time: float, sent: tuple[float, float] | None) -> Measurement:
        """Return the measurements that were delivered since the last call up to `time` [s], with the newest pose."""
        pose = None
        while self._pending_poses and self._pending_poses[0][0] <= time + TIME_TOLERANCE:
            _, pose = self._pending_poses.popleft()
        measurement = Measurement(
            pose=pose,
            wheel_twist=self._wheel_twist,
            yaw_rate=self._yaw_rate,
            wheel_speeds=self._wheel_speeds,
            sent=sent,
        )
        self._wheel_speeds = self._wheel_twist = self._yaw_rate = None
        return measurement


def _white(seed: np.random.SeedSequence, deviations: FloatArray) -> Iterator[FloatArray]:
    """Yield white noise (k,) with standard deviations `deviations` (k,) for each sample, independent of `_BLOCK`."""
    stream = np.random.default_rng(seed)
    while True:
        yield from deviations * stream.standard_normal((_BLOCK, len(deviations)))


def _published_covariance(covariance: FloatArray) -> FloatArray | None:
    """Return a covariance for measurements; None for an exact sensor, since a filter must not divide by zero."""
    if not covariance.any():
        return None
    covariance.setflags(write=False)
    return covariance
