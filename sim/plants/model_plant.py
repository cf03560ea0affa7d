"""Plant that moves as a velocity model: fast, with a closed-form solution."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from diffdrive_mpc.models.base_effects import BaseEffects
from diffdrive_mpc.models.interface import FloatArray, Measurement
from diffdrive_mpc.models.nonlinear_model import NonlinearModel
from diffdrive_mpc.models.pose import integrate_pose
from diffdrive_mpc.models.robot import Robot, load_robot
from diffdrive_mpc.models.velocity_model import VelocityModel
from diffdrive_mpc.models.wheels import WheelKinematics
from diffdrive_mpc.sim.plants.base_motion import BaseMotion
from diffdrive_mpc.sim.plants.drivetrain import clip_command
from diffdrive_mpc.sim.plants.identified_robot import UnexplainedMotion
from diffdrive_mpc.sim.plants.surface import BodySlip
from diffdrive_mpc.sim.sensing.sensor_set import SensorSet
from diffdrive_mpc.sim.sensing.sensors import Sensors


class ModelPlant:
    """Plant with velocity model, extra dead time, slip, and the sensors of the physics; see `sim.plants.plant.Plant`.

    The model's v is that of the encoders, its omega that of the gyro on the surface of the identification. The twist of
    a sample is the mean of the outputs at both ends, and the pose moves along the exact arc of this mean; with base
    effects, this applies to each of several steps of a sample. Poses are those of the centre of rotation.

    Parameters
    ----------
    model
        The velocity model.
    slip
        Slip from the model's twist to the true twist.
    sensors
        Sensor parameters.
    seed
        Seed of the noise, not negative.
    extra_dead_time
        Dead time in addition to that of the model, for both channels [s].
    effects
        Base effects; none by default.
    robot
        Geometry, sample time and limits; by default the robot of the papers.
    disturbance
        Additional motion of the body, which the encoders do not measure; None by default.
    """

    def __init__(
        self,
        model: VelocityModel | NonlinearModel,
        slip: BodySlip,
        sensors: SensorSet,
        seed: int = 0,
        *,
        extra_dead_time: float = 0.0,
        effects: BaseEffects | None = None,
        robot: Robot | None = None,
        disturbance: UnexplainedMotion | None = None,
    ) -> None:
        self._disturbance = disturbance
        self._robot, self._name = robot or load_robot(), model.name
        delayed = model.with_extra_dead_time([extra_dead_time, extra_dead_time])
        self._motion = BaseMotion(delayed, effects or BaseEffects(), self._robot.sample_time)
        self._slip = slip
        self._kinematics = WheelKinematics(self._robot.wheel_radius, self._robot.track)
        self._sensors = Sensors(sensors, self._kinematics, self._robot.sample_time, seed=seed, noisy_encoders=True)
        self.reset(np.zeros(3))

    def __repr__(self) -> str:
        """Describe the plant in one line."""
        return f"ModelPlant of {self._name!r}, samples of {self.sample_time:g} s"

    @property
    def sample_time(self) -> float:
        """Time between two control ticks [s]."""
        return self._robot.sample_time

    @property
    def time(self) -> float:
        """Time since the last reset [s]."""
        return self._tick * self.sample_time

    @property
    def true_pose(self) -> FloatArray:
        """(3,) x [m], y [m], theta [rad, unwrapped] midway between the wheels."""
        return self._pose.copy()

    @property
    def true_twist(self) -> FloatArray:
        """(3,) forward and lateral speed [m/s] and yaw rate [rad/s], body frame."""
        return self._body(self._motion.body)

    def reset(self, pose: ArrayLike) -> None:
        """Reset the robot to rest at `pose` (3,) at time 0, and restart the noise."""
        self._tick = 0
        self._sent: tuple[float, float] | None = None
        self._pose = np.array(pose, dtype=float)
        self._motion.reset()
        self._rate = np.zeros(2)
        self._sensors.reset(self._pose, np.zeros(4))

    def measure(self) -> Measurement:
        """Collect the sensor data since the last call."""
        return self._sensors.collect(self.time, self._sent)

    def advance(self, command: ArrayLike) -> None:
        """Send `command` (2,) and advance by one sample; raise ValueError unless it is two finite numbers."""
        sent = clip_command(command, self._robot.limits)
        self._sent = (float(sent[0]), float(sent[1]))
        arcs, before = [], self._motion.body
        for step in range(self._motion.steps):
            motion = self._motion.advance(sent)
            twist = self._body(motion.mean)
            arcs.append((self.time + step * self._motion.step_time, self._pose, twist))
            self._pose = self._integrate(self._pose, twist, self._motion.step_time)
        yaw_rate = float(self._body(motion.body)[2])
        self._rate = (self._motion.body - before) / self.sample_time
        self._tick += 1
        for due in self._sensors.poses_due(self.time):
            start, pose, twist = [arc for arc in arcs if arc[0] <= due][-1]
            self._sensors.see_pose(due, self._pose if due == self.time else self._integrate(pose, twist, due - start))
        wheel_speeds = self._kinematics.wheel_speeds(self._slip.wheels(motion.wheels))
        self._sensors.see_motion(self.time, wheel_speeds, yaw_rate)

    def _body(self, output: FloatArray) -> FloatArray:
        """Compute the twist (3,) of the body in this sample from the output (2,) of the model."""
        body = self._slip.body(output)
        return body if self._disturbance is None else body + self._disturbance.twist(self._tick, output, self._rate)

    def _integrate(self, pose: FloatArray, twist: FloatArray, duration: float) -> FloatArray:
        """Move `pose` (3,) for `duration` [s] with constant body `twist` (3,)."""
        v, lateral, omega = twist.tolist()
        # A body with side-slip moves along the same arc as a body that points in the direction of travel.
        forward = math.copysign(1.0, v)
        slip = math.atan2(forward * lateral, abs(v))
        result = integrate_pose(pose + np.array([0.0, 0.0, slip]), forward * math.hypot(v, lateral), omega, duration)
        result[2] -= slip
        return result
