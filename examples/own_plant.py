"""Simulate your own robot in the closed loop, as a class with the members of this example.

The example is a heavy machine that follows commands slowly. Because of its soft tyres, its yaw rate is 25 % lower than
that of its wheels.
"""

import numpy as np

from diffdrive_mpc import Controller, Measurement, Stamped, integrate_pose, load_config, load_trajectory, simulate
from diffdrive_mpc.models import VelocityModel

LAG = np.array([0.25, 0.15])  # time constants of forward speed and yaw rate [s]
YAW_GAIN = 0.75  # true yaw rate over the yaw rate of the wheels


class HeavyRobot:
    """First-order lags in v and omega; a gyro, encoders, and a pose sensor with 5 mm of noise at every second tick."""

    sample_time = 0.04  # time between two ticks [s]

    def reset(self, pose):
        """Reset to rest at `pose`: x [m], y [m], theta [rad]; every reset restarts the same noise."""
        self._noise, self._tick = np.random.default_rng(0), 0
        self.true_pose, self._wheels = np.array(pose, dtype=float), np.zeros(2)

    @property
    def time(self):
        return self._tick * self.sample_time

    @property
    def true_twist(self):
        """Forward speed, lateral speed and yaw rate, for the statistics only; not an input of the controller."""
        return np.array([self._wheels[0], 0.0, YAW_GAIN * self._wheels[1]])

    def measure(self):
        """Return the measurements since the last tick, each with its time; None if there is no new one."""
        pose = self.true_pose + self._noise.normal(scale=[0.005, 0.005, 0.005])
        return Measurement(
            pose=Stamped(pose, self.time) if self._tick % 2 == 0 else None,
            wheel_twist=Stamped(self._wheels.copy(), self.time),
            yaw_rate=Stamped(self.true_twist[2], self.time),
        )

    def advance(self, command):
        """Follow `command` (v, omega) for one sample."""
        before, share = self.true_twist, 1.0 - np.exp(-self.sample_time / LAG)
        self._wheels = self._wheels + share * (np.asarray(command) - self._wheels)
        v, _, omega = 0.5 * (before + self.true_twist)
        self.true_pose = integrate_pose(self.true_pose, v, omega, self.sample_time)
        self._tick += 1


# The model of the controller, x' = A x + B u, contains the lags but not the slip, which is estimated during the drive.
model = VelocityModel("heavy robot", "ssm", A=np.diag(-1 / LAG), B=np.diag(1 / LAG), C=np.eye(2))
config = load_config("ssm", {"sample_time": HeavyRobot.sample_time, "horizon": 25})
controller = Controller(config, model=model)
print(simulate(controller, HeavyRobot(), load_trajectory("s")))
