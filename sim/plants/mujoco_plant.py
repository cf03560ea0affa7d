"""Physics plant: chassis in MuJoCo with link, firmware, motor drivers and sensors."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike

from diffdrive_mpc.models.errors import checked_methods
from diffdrive_mpc.models.interface import FloatArray, Measurement
from diffdrive_mpc.models.robot import Robot, load_robot
from diffdrive_mpc.models.wheels import WheelKinematics
from diffdrive_mpc.sim.disturbances.disturbance_types import Span
from diffdrive_mpc.sim.disturbances.scenario import Scenario
from diffdrive_mpc.sim.plants.base_commands import BaseCommands, CommandShaping
from diffdrive_mpc.sim.plants.chassis import Chassis
from diffdrive_mpc.sim.plants.disturbed_plant import DisturbedPhysics
from diffdrive_mpc.sim.plants.drivetrain import CommandShaper, DelayLine, SpeedObserver, VelocityLoops, clip_command
from diffdrive_mpc.sim.plants.plant import NativePlant
from diffdrive_mpc.sim.plants.plug_ins import Scene, SimulatorPart
from diffdrive_mpc.sim.plants.twin import Twin
from diffdrive_mpc.sim.plants.twin_parameters import Firmware, TwinParameters, load_firmware, load_twin_parameters
from diffdrive_mpc.sim.sensing.sensor_set import SensorSet
from diffdrive_mpc.sim.sensing.sensors import TIME_TOLERANCE, Sensors

# Spawn key of the random encoder phases; sensors use the keys 0, 1, 2, ..., which are always lower.
_ENCODER_PHASE_KEY = 1_000


@checked_methods
class MujocoPlant(NativePlant):
    """Digital twin of the papers' robot or of another robot, see `sim.plants.plant.Plant`.

    Parameters
    ----------
    friction
        Sliding friction coefficient of the surface.
    sensors
        Sensor parameters.
    seed
        Non-negative seed of the noise.
    robot, twin, firmware
        Parameters of the robot; by default those of the papers' robot.
    base
        Effects of the base on commands; None for a base without effects.
    scenario
        Disturbances of chassis and motors; `sim.plants.disturbed_plant.DisturbedPlant` applies all others.
    sideways
        Ratio of friction across to friction along the rolling direction of the wheels [-].
    sample_time
        Duration of a command [s]; by default that of `robot`. The physics step remains approximately the same.
    scene
        Geometry around the robot; None if there is only the surface.
    parts
        Devices that observe the motors, by name.
    """

    def __init__(
        self,
        friction: float,
        sensors: SensorSet,
        seed: int = 0,
        *,
        robot: Robot | None = None,
        twin: TwinParameters | None = None,
        firmware: Firmware | None = None,
        base: BaseCommands | None = None,
        scenario: Scenario | None = None,
        sideways: float = 1.0,
        sample_time: float | None = None,
        scene: Scene | None = None,
        parts: Mapping[str, SimulatorPart] | None = None,
    ) -> None:
        robot, twin = robot or load_robot(), twin or load_twin_parameters()
        self._robot, self._friction = robot, friction
        self.parts = parts or {}
        self._sample_time = robot.sample_time if sample_time is None else sample_time
        # The physics step, and thus the behaviour, does not depend on the sample time of the controller.
        self._substeps = max(1, round(twin.substeps * self._sample_time / robot.sample_time))
        step = self._sample_time / self._substeps
        pulse = 2 * np.pi / robot.encoder_pulses
        phase = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(_ENCODER_PHASE_KEY,))).random(4)
        load, slope = (scenario.payload, scenario.slope) if scenario else (None, None)
        self._chassis = Chassis(robot, twin, friction, step, load, slope, sideways, scene)
        self._delay_line = DelayLine(twin.link.dead_time)
        self._shaping = None if base is None else CommandShaping(base, self._sample_time)
        self._shaper = CommandShaper(firmware or load_firmware(), robot, step)
        self._observer = SpeedObserver(twin.driver.observer_bandwidth, pulse, step, phase)
        self._loops = VelocityLoops(twin.driver, twin.motor, pulse, step)
        self._twin = Twin(self._delay_line, self._shaper, self._observer, self._loops, self._chassis, self._substeps)
        self._offsets = np.arange(self._substeps + 1) * step
        self._disturbances: DisturbedPhysics | None = None
        if scenario is not None:
            wheel_base, torque = twin.chassis.wheel_base, twin.motor.stall_torque
            self._disturbances = DisturbedPhysics(scenario, self._chassis, self._loops, friction, wheel_base, torque)
        # The counts of the observer cause the encoder noise; a sensor set without encoder noise reads the true speeds.
        self._exact_speeds = sensors.encoders.speed_sd == 0.0
        kinematics = WheelKinematics(robot.wheel_radius, robot.track)
        self._sensors = Sensors(sensors, kinematics, self._sample_time, seed=seed, noisy_encoders=False)
        self.reset(np.zeros(3))

    def __repr__(self) -> str:
        """Describe the plant in one line."""
        return f"MujocoPlant, friction {self._friction:g}, samples of {self._sample_time:g} s"

    @property
    def sample_time(self) -> float:
        """Time between two control ticks [s]."""
        return self._sample_time

    @property
    def time(self) -> float:
        """Time since the last reset [s]."""
        return self._tick * self.sample_time

    @property
    def true_pose(self) -> FloatArray:
        """(3,) x [m], y [m], theta [rad, unwrapped] of the point midway between the wheels."""
        return self._chassis.pose

    @property
    def true_twist(self) -> FloatArray:
        """(3,) forward and lateral speed [m/s] and yaw rate [rad/s] in the body frame."""
        return self._chassis.twist

    @property
    def chassis(self) -> Chassis:
        """Chassis in MuJoCo, which provides energy, contacts and true wheel speeds."""
        return self._chassis

    @property
    def motors(self) -> FloatArray:
        """(steps, 2, 4) torques [N m] and wheel speeds [rad/s] of the last sample; see `sim.plants.drivetrain`.

        The order is front left, front right, rear left, rear right. The next sample overwrites the values.
        """
        return self._twin.motors

    @property
    def patch_spans(self) -> list[Span]:
        """First and last time on each patch reached since the last reset [s]."""
        return self._disturbances.patch_spans if self._disturbances else []

    def reset(self, pose: ArrayLike) -> None:
        """Reset the robot to rest at `pose` (3,) at time 0, and restart the noise."""
        self._tick = 0
        self._sent: tuple[float, float] | None = None
        self._chassis.reset(pose)
        self._delay_line.reset()
        if self._shaping is not None:
            self._shaping.reset()
        self._shaper.reset()
        self._observer.reset()
        self._loops.reset()
        if self._disturbances is not None:
            self._disturbances.reset()
        self._sensors.reset(self._chassis.pose, np.zeros(4))
        for part in self.parts.values():
            part.reset()

    def measure(self) -> Measurement:
        """Collect the sensor data since the last call."""
        return self._sensors.collect(self.time, self._sent)

    def advance(self, command: ArrayLike) -> None:
        """Send `command` (2,) and advance by one sample; for errors see `sim.plants.plant.Plant`."""
        sent = clip_command(command, self._robot.limits)
        self._sent = (float(sent[0]), float(sent[1]))
        if self._shaping is None:
            self._delay_line.send(self.time, sent)
        else:
            for start, twist in self._shaping.levels(self.time, sent):
                self._delay_line.send(start, twist)
        edges, poses = self._twin.edges, self._twin.poses
        np.add(self.time, self._offsets, out=edges)
        # The last edge is exactly the time of the next tick, from which the sum of steps differs by rounding.
        edges[-1] = (self._tick + 1) * self.sample_time
        if self._disturbances is None:
            self._twin.advance()
        else:
            self._disturbances.advance(self._twin)
        self._tick += 1
        for time in self._sensors.poses_due(edges[-1]):
            # The pose is interpolated in the first physics step that ends after its time.
            k = int(np.searchsorted(edges[1:] + TIME_TOLERANCE, time))
            share = (time - edges[k]) / (edges[k + 1] - edges[k])
            self._sensors.add_pose(time, poses[k] + share * (poses[k + 1] - poses[k]))
        for part in self.parts.values():
            part.take(self._twin.motors)
        speeds = self._chassis.wheel_speeds if self._exact_speeds else self._observer.speed
        self._sensors.add_motion(self.time, speeds, self._chassis.yaw_rate)
