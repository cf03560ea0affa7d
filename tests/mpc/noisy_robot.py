"""A robot whose motion and sensors are random just as the filter assumes: for tests of its consistency."""

from __future__ import annotations

import numpy as np
from ideal_robot import WHEEL_YAW_RATIO, IdealRobot

from diffdrive_mpc.models import DiscreteModel, Measurement, Stamped
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.mpc.config.schema import Estimator
from diffdrive_mpc.mpc.problem.slip import Slip


class NoisyRobot(IdealRobot):
    """Draws its slip, its process noise and its measurement noise from what `settings` say."""

    def __init__(self, model: DiscreteModel, settings: Estimator, seed: int) -> None:
        rng = np.random.default_rng(seed)
        s = settings
        slip = Slip(
            v_offset=s.v_offset_uncertainty * rng.normal(),
            omega_gain=1 + s.omega_gain_uncertainty * rng.normal(),
            longitudinal_gain=1 + s.longitudinal_gain_uncertainty * rng.normal(),
            yaw_gain=1 + s.yaw_gain_uncertainty * rng.normal(),
            side_slip=s.side_slip + s.side_slip_uncertainty * rng.normal(),
            turn_ahead=s.turn_ahead_uncertainty * rng.normal(),
            turn_left=s.turn_left_uncertainty * rng.normal(),
            load_shift=s.load_shift + s.load_shift_uncertainty * rng.normal(),
        )
        super().__init__(model, np.zeros(3), slip=slip, gyro_bias=s.gyro_bias_uncertainty * rng.normal())
        self.rng, self.settings = rng, s
        self.drive = (model.B0 + model.B1) * [s.v_input_noise, s.omega_input_noise]

    def measure(self) -> Measurement:
        s, ratio = self.settings, WHEEL_YAW_RATIO / self.model.dc_gain[1, 1]
        pose = self.pose + self.rng.normal(size=3) * [s.position_noise, s.position_noise, s.heading_noise]
        wheels = self.wheels * [1.0, ratio] + self.rng.normal(size=2) * [s.wheel_speed_noise, s.wheel_yaw_rate_noise]
        gyro = self.twist[1] + self.gyro_bias + s.yaw_rate_noise * self.rng.normal()
        return Measurement(
            pose=Stamped(pose, self.time), wheel_twist=Stamped(wheels, self.time), yaw_rate=Stamped(gyro, self.time)
        )

    def advance(self, command: FloatArray) -> None:
        s, dt = self.settings, self.model.dt
        start, before = self.pose, self.twist
        super().advance(command)
        step = self.rng.normal(size=3) * np.sqrt(dt) * [s.position_drift, s.position_drift, s.heading_drift]
        self.poses[-1] = start + self.moved(start[2], before, self.twist) + step
        self.state = self.state + self.drive @ self.rng.normal(size=2)
