"""Plants with the disturbances of a scenario."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from diffdrive_mpc.models.interface import FloatArray, Measurement
from diffdrive_mpc.models.robot import Robot
from diffdrive_mpc.models.wheels import WheelKinematics
from diffdrive_mpc.sim.disturbances.disturbance_types import Blockade, Patch, Push, Span
from diffdrive_mpc.sim.disturbances.scenario import Scenario
from diffdrive_mpc.sim.disturbances.sensor_faults import SensorFaults
from diffdrive_mpc.sim.plants.chassis import WHEELS, Chassis
from diffdrive_mpc.sim.plants.drivetrain import VelocityLoops, clip_command
from diffdrive_mpc.sim.plants.plant import Plant, PlantAround
from diffdrive_mpc.sim.plants.twin import Twin


class DisturbedPlant(PlantAround):
    """Wrapper that adds start offset, sensor faults and false commands to a plant, see `sim.plants.plant.Plant`.

    Parameters
    ----------
    plant
        Plant that applies all other disturbances of the scenario.
    scenario
        Disturbances with their times.
    robot
        Robot with the command limits and the kinematics for encoder faults.
    patch_spans
        Function that returns the time spans of the patches reached by the plant.
    """

    def __init__(
        self, plant: Plant, scenario: Scenario, robot: Robot, patch_spans: Callable[[], Sequence[Span]] = tuple
    ) -> None:
        super().__init__(plant)
        self._scenario, self._limits, self._patch_spans = scenario, robot.limits, patch_spans
        self._faults = SensorFaults(scenario, WheelKinematics(robot.wheel_radius, robot.track))
        self.reset(np.zeros(3))

    @property
    def scenario(self) -> Scenario:
        """Scenario with the values of this run."""
        return self._scenario

    @property
    def disturbance(self) -> Span | None:
        """Start of the first and end of the last disturbance up to now [s]; None if no disturbance has started.

        Disturbances that last until the end of the run are ignored for the end; the end is infinite if all
        disturbances last until the end of the run.
        """
        past_spans = [span for span in (*self._scenario.spans, *self._patch_spans()) if span[0] <= self.time]
        if not past_spans:
            return None
        ends = [end for _, end in past_spans if math.isfinite(end)]
        return min(start for start, _ in past_spans), min(self.time, max(ends)) if ends else math.inf

    def reset(self, pose: ArrayLike) -> None:
        """Reset to time 0 and to rest at `pose` (3,) plus the start offset, and restart the noise."""
        start = np.array(pose, dtype=float)
        offset = self._scenario.start_offset
        if offset is not None:
            c, s = np.cos(start[2]), np.sin(start[2])
            start += [c * offset.along - s * offset.across, s * offset.along + c * offset.across, offset.heading]
        self._sent: tuple[float, float] | None = None
        self._faults.reset()
        self._plant.reset(start)

    def measure(self) -> Measurement:
        """Collect the sensor data since the last call, with faults."""
        return replace(self._faults.apply(self._plant.measure(), self.time), sent=self._sent)

    def advance(self, command: ArrayLike) -> None:
        """Send `command` (2,) or a false command, and advance by one sample; see `Plant.advance` for errors."""
        sent = clip_command(command, self._limits)
        false_commands = [item for item in self._scenario.false_commands if item.contains(self.time)]
        # Measurements contain the command of the controller, since it does not know about the false command.
        self._plant.advance([false_commands[-1].v, false_commands[-1].omega] if false_commands else sent)
        self._sent = (float(sent[0]), float(sent[1]))


class DisturbedPhysics:
    """Disturbances of the physics: patches, slipping wheels, pushes, blockades, weak motors and battery sag.

    Payload and slope are part of the chassis.

    Parameters
    ----------
    scenario
        Disturbances with their times.
    chassis, loops
        Chassis and velocity loops to which the disturbances are applied.
    friction
        Sliding friction coefficient of the surface around the patches.
    wheel_base
        Distance between the axles [m].
    stall_torque
        Stall torque of a nominal motor [N m].
    """

    def __init__(
        self,
        scenario: Scenario,
        chassis: Chassis,
        loops: VelocityLoops,
        friction: float,
        wheel_base: float,
        stall_torque: float,
    ) -> None:
        self._scenario, self._chassis, self._loops = scenario, chassis, loops
        self._friction, self._stall_torque = friction, stall_torque
        ahead = np.array([wheel_base / 2 if name.startswith("front") else -wheel_base / 2 for name in WHEELS])
        self._patches = [(patch, _wheels_under(patch), *_patch_ends(patch, ahead)) for patch in scenario.patches]
        self.reset()

    def reset(self) -> None:
        """Reset the state for a robot at the start of its path."""
        self._travelled = 0.0
        self._position = self._chassis.pose[:2]
        self._patch_spans: list[Span | None] = [None] * len(self._patches)
        self._torque_share = 0.0
        self._loops.supply = 1.0
        self._anchors: list[FloatArray | None] = [None] * len(self._scenario.blockades)
        self._chassis.release()
        self._set_friction(0.0)

    @property
    def patch_spans(self) -> list[Span]:
        """First and last time of a wheel on each reached patch [s]; the last is infinite for an endless patch."""
        return [span for span in self._patch_spans if span is not None]

    def advance(self, twin: Twin) -> None:
        """Advance `twin` by one control sample with disturbances; raise RobotLostError if the robot is lost."""
        edges = twin.edges.tolist()
        for k, (start, end) in enumerate(itertools.pairwise(edges)):
            self.before_step(start, end)
            # The steps are not combined in one call in C, because disturbances change the torques of the motors.
            twin.step(k, self.motors(twin.torques(k), start))

    def before_step(self, start: float, end: float) -> None:
        """Apply the disturbances for the physics step from `start` to `end` [s]."""
        scenario = self._scenario
        if self._patches or scenario.slipping_wheels:
            position = self._chassis.pose[:2]
            self._travelled += math.hypot(*(position - self._position))
            self._position = position
            self._set_friction(start)
        if scenario.pushes or scenario.blockades:
            self._chassis.release()
            for push in scenario.pushes:
                self._push(push, push.share(start, end))
            for i, blockade in enumerate(scenario.blockades):
                if blockade.contains(start):
                    self._apply_blockade(i, blockade)
        if scenario.battery:
            # The torque of this step depends on the supply voltage, so the voltage drop is that of the last step.
            drop = scenario.battery.load_drop * self._torque_share
            self._loops.supply = max(0.0, scenario.battery.voltage(start) - drop)

    def motors(self, torques: FloatArray, time: float) -> FloatArray:
        """Reduce the `torques` (4,) [N m] by the weak motors at `time` [s], in place, and return them."""
        for motor in self._scenario.weak_motors:
            if motor.contains(time):
                torques[WHEELS.index(motor.wheel)] *= motor.factor
        self._torque_share = float(np.mean(np.abs(torques))) / self._stall_torque
        return torques

    def _push(self, push: Push, share: float) -> None:
        """Apply the mean force over a step, `share` times the force of the push, so that the momentum is exact."""
        forward, left = push.force * math.cos(push.direction), push.force * math.sin(push.direction)
        self._chassis.push(share * forward, share * left, share * push.yaw_torque, push.height)

    def _apply_blockade(self, i: int, blockade: Blockade) -> None:
        """Apply spring and damper of blockade `i`; its anchor is the pose of the body at the start of the blockade."""
        pose, (v, lateral, omega) = self._chassis.pose, self._chassis.twist
        anchor = self._anchors[i]
        anchor = self._anchors[i] = pose if anchor is None else anchor
        x, y, rotation = pose - anchor
        c, s = math.cos(pose[2]), math.sin(pose[2])
        forward = -blockade.stiffness * (c * x + s * y) - blockade.damping * v
        left = -blockade.stiffness * (c * y - s * x) - blockade.damping * lateral
        torque = -blockade.yaw_stiffness * rotation - blockade.yaw_damping * omega
        self._chassis.push(forward, left, torque, blockade.height)

    def _set_friction(self, time: float) -> None:
        friction = np.full(4, self._friction)
        for i, (patch, wheels, starts, ends) in enumerate(self._patches):
            on_patch = wheels & (starts <= self._travelled) & (self._travelled < ends)
            friction[on_patch] = patch.coefficient(self._friction)
            self._record_crossing(i, time, bool(on_patch.any()), patch)
        for slip in self._scenario.slipping_wheels:
            if slip.contains(time):
                friction[WHEELS.index(slip.wheel)] = slip.friction
        self._chassis.set_friction(friction)

    def _record_crossing(self, i: int, time: float, is_on_patch: bool, patch: Patch) -> None:
        if is_on_patch:
            span = self._patch_spans[i]
            self._patch_spans[i] = (time if span is None else span[0], math.inf if patch.length is None else time)


def _wheels_under(patch: Patch) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Return a mask (4,) of the wheels on the side of the patch."""
    return np.array([patch.side == "both" or name.endswith(patch.side) for name in WHEELS])


def _patch_ends(patch: Patch, ahead: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Compute the travelled distances (4,) [m] at which wheels enter and leave the patch.

    `ahead` (4,) are the distances of the wheels ahead of the centre [m].
    """
    length = math.inf if patch.length is None else patch.length
    return patch.start - ahead, patch.start + length - ahead
