"""A velocity model as plant: fast, and the truth is known in closed form."""

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
    """A velocity model, extra dead time and slip behind the same sensors as the physics; see `sim.plants.plant.Plant`.

    The model's v is that of the encoders, its omega that of the gyro on the surface it was identified on. Over a sample
    the twist is the mean of the outputs at both ends, and the pose moves along the exact arc of that mean. With effects
    of a base that holds for each of a few steps of a sample. Poses are those of the centre of rotation, as a pose mount
    gives them.

    Parameters
    ----------
    model
        The velocity model.
    slip
        Slip between the model's twist and the true one.
    sensors
        Sensor parameters.
    seed
        Seed of all noise, not negative.
    extra_dead_time
        Dead time on top of the model's own, both channels [s].
    effects
        Effects of the base around the model; none by default.
    robot
        Geometry, sample time and limits; by default the robot of the papers.
    disturbance
        Motion of the body beyond that, which the encoders do not measure. None by default.
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
        late = model.with_extra_dead_time([extra_dead_time, extra_dead_time])
        self._motion = BaseMotion(late, effects or BaseEffects(), self._robot.sample_time)
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
        """Put the robot at rest at `pose` (3,) at time 0 and restart the noise from the seed."""
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
        """Send `command` (2,) and let one sample pass; raises ValueError unless it is two finite numbers."""
        sent = clip_command(command, self._robot.limits)
        self._sent = (float(sent[0]), float(sent[1]))
        arcs, before = [], self._motion.body
        for step in range(self._motion.steps):
            motion = self._motion.advance(sent)
            twist = self._body(motion.mean)
            arcs.append((self.time + step * self._motion.step_time, self._pose, twist))
            self._pose = self._moved(self._pose, twist, self._motion.step_time)
        yaw_rate = float(self._body(motion.body)[2])
        self._rate = (self._motion.body - before) / self.sample_time
        self._tick += 1
        for look in self._sensors.poses_due(self.time):
            start, pose, twist = [arc for arc in arcs if arc[0] <= look][-1]
            self._sensors.see_pose(look, self._pose if look == self.time else self._moved(pose, twist, look - start))
        wheel_speeds = self._kinematics.wheel_speeds(self._slip.wheels(motion.wheels))
        self._sensors.see_motion(self.time, wheel_speeds, yaw_rate)

    def _body(self, output: FloatArray) -> FloatArray:
        """Return the twist (3,) of the body in this sample for the output (2,) of the model."""
        body = self._slip.body(output)
        return body if self._disturbance is None else body + self._disturbance.twist(self._tick, output, self._rate)

    def _moved(self, pose: FloatArray, twist: FloatArray, duration: float) -> FloatArray:
        """Move `pose` (3,) for `duration` [s] with constant body `twist` (3,)."""
        v, lateral, omega = twist.tolist()
        # A body that crabs moves along the same arc as one that points in the direction of travel.
        forward = math.copysign(1.0, v)
        crab = math.atan2(forward * lateral, abs(v))
        moved = integrate_pose(pose + np.array([0.0, 0.0, crab]), forward * math.hypot(v, lateral), omega, duration)
        moved[2] -= crab
        return moved
