"""What a plant did under a row of commands."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.results import ReadOnlyArrays
from diffdrive_mpc.sim.plant import Plant


@dataclass(frozen=True)
class Log(ReadOnlyArrays):
    """An open-loop drive, K samples. Row k was measured at `time[k]`, just before `command[k]` was sent.

    Attributes
    ----------
    time
        (K,) [s].
    command
        (K, 2) v_ref [m/s], omega_ref [rad/s].
    wheel_speeds
        (K, 4) front left, front right, rear left, rear right [rad/s], as the drivers report them.
    wheel_twist
        (K, 2) v [m/s], omega [rad/s] from these speeds and the geometric track.
    yaw_rate
        (K,) of the gyro [rad/s].
    true_pose
        (K, 3) x [m], y [m], theta [rad, unwrapped].
    true_twist
        (K, 3) forward and lateral speed [m/s], yaw rate [rad/s].
    """

    time: FloatArray
    command: FloatArray
    wheel_speeds: FloatArray
    wheel_twist: FloatArray
    yaw_rate: FloatArray
    true_pose: FloatArray
    true_twist: FloatArray

    @property
    def output(self) -> FloatArray:
        """(K, 2) what a velocity model predicts: v [m/s] of the encoders, omega [rad/s] of the gyro."""
        return np.column_stack([self.wheel_twist[:, 0], self.yaw_rate])


def record(plant: Plant, commands: ArrayLike, pose: ArrayLike = (0.0, 0.0, 0.0)) -> Log:
    """Reset `plant` to `pose` (3,) and drive it with `commands` (K, 2), one per sample.

    Raises
    ------
    ValueError
        If the commands are not rows of two finite numbers, or the plant does not report encoders and gyro every sample.
    """
    rows = np.asarray(commands, dtype=float)
    if rows.ndim != 2 or rows.shape[1] != 2 or not np.isfinite(rows).all():
        raise ValueError(f"commands of shape {rows.shape}: give (K, 2) finite numbers, v [m/s] and omega [rad/s]")
    plant.reset(pose)
    count = len(rows)
    time, yaw_rate = np.empty(count), np.empty(count)
    wheel_speeds, wheel_twist = np.empty((count, 4)), np.empty((count, 2))
    true_pose, true_twist = np.empty((count, 3)), np.empty((count, 3))
    for k, command in enumerate(rows):
        measurement = plant.measure()
        if measurement.wheel_speeds is None or measurement.wheel_twist is None or measurement.yaw_rate is None:
            raise ValueError(f"no encoders or gyro at {plant.time:.3f} s: a log needs them every sample")
        time[k], true_pose[k], true_twist[k] = plant.time, plant.true_pose, plant.true_twist
        wheel_speeds[k], wheel_twist[k] = measurement.wheel_speeds.value, measurement.wheel_twist.value
        yaw_rate[k] = measurement.yaw_rate.value
        plant.advance(command)
    return Log(time, rows.copy(), wheel_speeds, wheel_twist, yaw_rate, true_pose, true_twist)
