"""Simulated robot for tests of the controller: exact motion of a discrete model, with optional sensor errors."""

from __future__ import annotations

import numpy as np

from diffdrive_mpc.models import DiscreteModel, Measurement, Stamped
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.mpc.config.schema import Estimator, Wheels
from diffdrive_mpc.mpc.problem.slip import Slip
from oracle.motion import arc, sideways, slid

# Ratio of the yaw rate from encoders and geometric track to the yaw rate of the firmware.
WHEEL_YAW_RATIO = Wheels().track / Wheels().encoder_track
# Settings for encoders without lag; the shipped configurations describe encoders with a lag.
PROMPT = {"sensors.wheels.lag": 0.0, "sensors.wheels.scale": 1.0}


class IdealRobot:
    """Robot with the motion of a discrete model; measurements are exact except for the errors in the arguments.

    Parameters
    ----------
    model
        The dynamics.
    pose
        Initial pose.
    late
        Delay of the poses in samples.
    slip
        Slip that maps the model's twist to the body's.
    gyro_bias
        Bias of the gyro [rad/s].
    noise
        Scale of the measurement noise: 1 is 5 mm, 0.3 degrees, 5 mm/s and 0.01 rad/s.
    """

    def __init__(
        self,
        model: DiscreteModel,
        pose: FloatArray,
        late: int = 0,
        slip: Slip | None = None,
        gyro_bias: float = 0.0,
        noise: float = 0.0,
        seed: int = 0,
    ) -> None:
        self.model, self.late, self.slip, self.noise = model, late, slip or Slip(), noise
        self.gyro_bias = gyro_bias
        self.rng = np.random.default_rng(seed)
        self.state = np.zeros(model.order)
        self.line = [np.zeros(2)] * (model.memory + 1)
        self.poses = [np.asarray(pose, dtype=float)] * (late + 1)
        self.k = 0

    @property
    def time(self) -> float:
        return self.k * self.model.dt

    @property
    def pose(self) -> FloatArray:
        return self.poses[-1]

    @property
    def wheels(self) -> FloatArray:
        """v [m/s] and omega [rad/s] of the wheels, as on a surface without slip."""
        moving = any(command.any() for command in self.line)
        return (self.model.C @ self.state + (self.slip.offset if moving else 0.0)) * [1.0, self.slip.omega_gain]

    @property
    def twist(self) -> FloatArray:
        v, omega = self.wheels * [self.slip.longitudinal_gain, self.slip.yaw_gain]
        return np.array([v + self.slip.turn_left * omega, omega])

    def measure(self) -> Measurement:
        scale, twist = self.noise * self.rng.normal(size=6), self.twist
        pose = self.poses[-1 - self.late] + scale[:3] * [0.005, 0.005, 0.0052]
        pose[2] = (pose[2] + np.pi) % (2 * np.pi) - np.pi
        return Measurement(
            pose=Stamped(pose, self.time - self.late * self.model.dt),
            wheel_twist=Stamped(
                self.wheels * [1.0, WHEEL_YAW_RATIO / self.model.dc_gain[1, 1]] + scale[3] * 0.005, self.time
            ),
            yaw_rate=Stamped(twist[1] + self.gyro_bias + scale[4] * 0.01, self.time),
        )

    def advance(self, command: FloatArray) -> None:
        before = self.twist
        self.line.append(np.array(command))
        recent = [self.line[-1 - self.model.delay[j]][j] for j in (0, 1)]
        previous = [self.line[-2 - self.model.delay[j]][j] for j in (0, 1)]
        self.state = self.model.A @ self.state + self.model.B0 @ recent + self.model.B1 @ previous
        self.poses.append(self.pose + self.moved(self.pose[2], before, self.twist))
        self.k += 1

    def moved(self, theta: float, start: FloatArray, end: FloatArray) -> FloatArray:
        """Return the displacement (3,) over a sample from the heading `theta`, with the mean twist of start and end."""
        (v, omega), dt, slip = 0.5 * (start + end), self.model.dt, self.slip
        ahead = slip.turn_ahead - slip.load_shift * (end - start)[0] / dt
        move = np.array(arc(theta, v, omega, dt, sideways(v, omega, slip.side_slip, ahead)))
        move[:2] += slid(theta, omega, dt, (slip.slide_x, slip.slide_y))
        return move


class NoisyRobot(IdealRobot):
    """Robot with random slip, process noise and measurement noise of the distributions in `settings`."""

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


def drive(controller, robot, reference, seconds, t0=0.0, change=None):
    """Return results, true poses and times of a closed loop; `change(k, measurement)` may replace measurements."""
    controller.start(reference, t0)
    results, poses, times = [], [], []
    for k in range(round(seconds / robot.model.dt)):
        measurement = robot.measure()
        if change is not None:
            measurement = change(k, measurement)
        result = controller.step(robot.time, measurement)
        results.append(result)
        poses.append(robot.pose)
        times.append(robot.time)
        robot.advance(result.command)
    return results, np.array(poses), np.array(times)
