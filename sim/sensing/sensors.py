"""Sensors of all plants, with noise, bias, rate and latency between the true state and the controller."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from diffdrive_mpc.models.interface import FloatArray, Measurement, Stamped
from diffdrive_mpc.models.wheels import WheelKinematics
from diffdrive_mpc.sim.core.library import address, load_twin, view
from diffdrive_mpc.sim.sensing.sensor_set import SensorSet

TIME_TOLERANCE = 1e-9
"""Tolerance of times for rounding errors of sums and multiples [s]."""
_BLOCK = 256
"""Minimum number of noise samples that are drawn at once."""


class Sensors:
    """Simulated sensors that convert true motion to measurements.

    The plant passes its motion to the sensors at each sample, and `collect` returns the delivered measurements. Every
    sensor has a separate random stream, so the rate of a sensor does not change the noise of other sensors.

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
        self._parameters, self._seed = parameters, seed
        pose, gyro, encoders = parameters.pose, parameters.gyro, parameters.encoders
        self._pose_sd = np.array([pose.position_sd, pose.position_sd, pose.heading_sd])
        self._speed_noise = encoders.speed_sd if noisy_encoders else 0.0
        stated_sd = self._pose_sd.copy()
        if pose.stated_position_sd is not None:
            stated_sd[:2] = pose.stated_position_sd
        ffi, self._lib = load_twin()
        self.c = c = ffi.new("sensor_unit *")
        """Parameters and state in C, see `sim/core/sensors.h`."""
        c.sample_time, c.period = sample_time, pose.period or sample_time
        c.latency, c.loss, c.heading_offset = pose.latency, pose.loss, pose.turned
        c.stamped_on_arrival = pose.stamped_on_arrival
        c.pose_signs = [1.0, -1.0 if pose.mirrored else 1.0, pose.theta_sign]
        c.gyro_scale, c.gyro_noise, c.max_gyro_reading = gyro.scale, gyro.noise_sd, gyro.largest
        # The order is front left, front right, rear left, rear right.
        c.wheels = [1, 0, 3, 2] if encoders.swapped else [0, 1, 2, 3]
        c.wheel_signs = [encoders.left, encoders.right] * 2
        c.to_wheels, c.to_body = kinematics.body_to_wheels.ravel().tolist(), kinematics.wheels_to_body.ravel().tolist()
        self._per_sample = 1 + math.ceil(sample_time / c.period)
        c.capacity = 2 + self._per_sample + math.ceil(pose.latency / c.period)
        self._pending = np.zeros((c.capacity, 5))
        c.pending = address(self._pending)
        to_body, speed_covariance = kinematics.wheels_to_body, encoders.speed_sd**2 * np.eye(4)
        self._speed_covariance, self._wheel_speeds = _published_covariance(speed_covariance), view(c.wheel_speeds)
        self._pose = _Reading(c.pose, np.diag(stated_sd**2))
        self._twist = _Reading(c.twist, encoders.speed_sd**2 * (to_body @ to_body.T))
        self._yaw_rate = _Reading(c.yaw_rate, np.array([[gyro.noise_sd**2]]))
        self.reset(np.zeros(3), np.zeros(4))

    def reset(self, pose: ArrayLike, wheel_speeds: ArrayLike) -> None:
        """Restart the noise at time 0 for a robot at rest at `pose` (3,)."""
        c = self.c
        pose_noise, gyro_noise, wheel_noise, losses = map(
            np.random.default_rng, np.random.SeedSequence(self._seed).spawn(4)
        )
        self._pose_noise = _Noise(c.pose_noise, self._pose_sd, pose_noise.standard_normal)
        self._losses = _Noise(c.loss_noise, np.ones(1), losses.random)
        self._wheel_noise = _Noise(c.wheel_noise, np.full(4, self._speed_noise), wheel_noise.standard_normal)
        c.gyro_bias = self._parameters.gyro.bias_sd * gyro_noise.standard_normal()
        self._yaw_rate_noise = _Noise(c.yaw_rate_noise, np.ones(1), gyro_noise.standard_normal)
        c.first_pending = c.pending_count = 0
        # The first pose is the latest one that arrives by time 0; with latency, it was measured before time 0.
        c.next_pose = -int(np.ceil((c.latency - TIME_TOLERANCE) / c.period))
        for time in self.poses_due(0.0):
            self.add_pose(time, pose)
        self.add_motion(0.0, wheel_speeds, 0.0)

    def draw_noise(self, samples: int) -> None:
        """Draw the noise of the next `samples` control samples in advance."""
        self._draw_pose_noise(samples * self._per_sample)
        self._draw_motion_noise(samples)

    def _draw_pose_noise(self, poses: int) -> None:
        self._pose_noise.draw(poses)
        if self.c.loss > 0.0:
            self._losses.draw(poses)

    def _draw_motion_noise(self, samples: int) -> None:
        self._wheel_noise.draw(samples)
        self._yaw_rate_noise.draw(samples)

    def poses_due(self, until: float) -> list[float]:
        """Return the times of pose measurements up to `until` [s]; `add_pose` must be called for each time."""
        due = []
        while self._lib.sensors_pose_due(self.c, until):
            due.append(self.c.due_time)
        return due

    def add_pose(self, time: float, pose: ArrayLike) -> None:
        """Measure the true `pose` (3,) at `time` [s] with the pose sensor."""
        self._draw_pose_noise(1)
        self._lib.sensors_add_pose(self.c, time, np.asarray(pose, dtype=float).tolist())

    def add_motion(self, time: float, wheel_speeds: ArrayLike, yaw_rate: float) -> None:
        """Measure wheel speeds (4,) [rad/s] with encoders and the true yaw rate [rad/s] with the gyro at `time` [s]."""
        self._draw_motion_noise(1)
        self._lib.sensors_add_motion(self.c, time, np.asarray(wheel_speeds, dtype=float).tolist(), yaw_rate)

    def collect(self, time: float, sent: tuple[float, float] | None) -> Measurement:
        """Return the measurements that were delivered since the last call up to `time` [s], with the newest pose."""
        self._lib.sensors_collect(self.c, time)
        twist, yaw_rate, speeds = self._twist.stamped(2), self._yaw_rate.stamped(), None
        if twist is not None:
            speeds = Stamped(self._wheel_speeds.copy(), twist.time, self._speed_covariance)
        measurement = Measurement(self._pose.stamped(3), twist, yaw_rate, speeds, sent)
        self._lib.sensors_clear(self.c)
        return measurement


class _Noise:
    """Noise of a sensor, drawn in blocks; samples do not depend on the blocks.

    Parameters
    ----------
    c
        Structure `sensor_noise` of the sensor in C.
    scale
        (k,) factors of the samples.
    stream
        Function that returns samples of the given shape.
    """

    def __init__(self, c: Any, scale: FloatArray, stream: Callable[[tuple[int, int]], FloatArray]) -> None:  # noqa: ANN401 - cffi has no types
        self._c, self._scale, self._stream, self._rows = c, scale, stream, np.empty((0, len(scale)))
        c.next = c.count = 0

    def draw(self, count: int) -> None:
        """Draw further samples if fewer than `count` samples remain."""
        c = self._c
        if c.count - c.next < count:
            new_rows = self._scale * self._stream((max(count, _BLOCK), len(self._scale)))
            self._rows = np.vstack([self._rows[c.next :], new_rows])
            c.rows, c.next, c.count = address(self._rows), 0, len(self._rows)


class _Reading:
    """Reading of a sensor in C with its covariance, which is None for an exact sensor."""

    def __init__(self, c: Any, covariance: FloatArray) -> None:  # noqa: ANN401 - cffi has no types
        self._c, self._value, self._covariance = c, view(c.value), _published_covariance(covariance)
        c.has_covariance = self._covariance is not None
        view(c.covariance)[: covariance.size] = covariance.ravel()

    def stamped(self, size: int | None = None) -> Stamped | None:
        """Return the reading with `size` values, by default as a single number; None if there is no new reading."""
        if not self._c.present:
            return None
        return Stamped(self._value[0] if size is None else self._value[:size].copy(), self._c.stamp, self._covariance)


def _published_covariance(covariance: FloatArray) -> FloatArray | None:
    """Return a covariance for measurements; None for an exact sensor, so that filters do not divide by zero."""
    if not covariance.any():
        return None
    covariance.setflags(write=False)
    return covariance
