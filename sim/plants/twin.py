"""Drivetrain and physics of a robot, with one call in C per control sample."""

from __future__ import annotations

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.sim.core.library import address, load_twin
from diffdrive_mpc.sim.plants.chassis import Chassis
from diffdrive_mpc.sim.plants.drivetrain import CommandShaper, DelayLine, SpeedObserver, VelocityLoops


class Twin:
    """Interface to `sim/core/twin.c`: whole control samples, or single steps if disturbances act between the steps.

    Parameters
    ----------
    line, shaper, observer, loops, chassis
        Components of the plant.
    steps
        Number of physics steps per control sample.

    Attributes
    ----------
    edges
        (steps + 1,) start and end time of each step of the control sample [s]; set by the caller.
    poses
        (steps + 1, 3) x [m], y [m], theta [rad, unwrapped] at the times `edges`.
    motors
        (steps, 2, 4) torque of each motor during each step [N m], and speed of the wheel at the end of the step
        [rad/s]. Torque times speed is the exact mean power of a step, since the physics integrates the wheel angles
        with the speed at the end of the step.
    """

    def __init__(
        self,
        line: DelayLine,
        shaper: CommandShaper,
        observer: SpeedObserver,
        loops: VelocityLoops,
        chassis: Chassis,
        steps: int,
    ) -> None:
        ffi, self._lib = load_twin()
        self._chassis, self._steps = chassis, steps
        self._parts = line, shaper, observer, loops, chassis  # keep the structures of the twin in memory
        self.edges, self.poses, self._torques = np.zeros(steps + 1), np.zeros((steps + 1, 3)), np.zeros(4)
        self.motors = np.zeros((steps, 2, 4))
        self._c = ffi.new("twin *", [*(part.c for part in self._parts), address(self.motors)])
        self._addresses = address(self.edges), address(self.poses)
        self._torques_address = address(self._torques)

    def advance(self) -> None:
        """Advance all steps of the control sample; raise RobotLostError if the robot is lost."""
        self._chassis.check(self._lib.twin_advance(self._c, self._steps, *self._addresses))

    def torques(self, step: int) -> FloatArray:
        """Compute the motor torques (4,) [N m] of a step."""
        self._lib.twin_drive(self._c, self.edges[step], self.edges[step + 1], self._torques_address)
        return self._torques

    def step(self, step: int, torques: FloatArray) -> None:
        """Advance a step with `torques` (4,) [N m]; raise RobotLostError if the robot is lost."""
        self.poses[step] = self._chassis.pose
        self._torques[:] = torques
        self._chassis.check(self._lib.twin_step(self._c, self._torques_address))
        self.poses[step + 1] = self._chassis.pose
        self.motors[step] = torques, self._chassis.wheel_speeds
