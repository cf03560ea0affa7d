"""A plant to which a scenario happens: what every plant can suffer, and when it began and ended."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from diffdrive_mpc.models.interface import Measurement
from diffdrive_mpc.models.robot import Robot
from diffdrive_mpc.models.wheels import WheelKinematics
from diffdrive_mpc.sim.disturbances.disturbance_types import Span
from diffdrive_mpc.sim.disturbances.scenario import Scenario
from diffdrive_mpc.sim.disturbances.sensor_faults import SensorFaults
from diffdrive_mpc.sim.plants.link import clip_command
from diffdrive_mpc.sim.plants.plant import Plant, PlantAround


class DisturbedPlant(PlantAround):
    """Start offset, sensor faults and false commands around any plant; see `sim.plants.plant.Plant`.

    Parameters
    ----------
    plant
        The plant, which brings about all other disturbances of the scenario itself.
    scenario
        What happens when.
    robot
        Commands are clipped to its limits, and `sent` says so; a dead encoder spoils the twist by its wheels.
    crossed
        Gives the spans of the patches that the plant has met so far.
    """

    def __init__(
        self,
        plant: Plant,
        scenario: Scenario,
        robot: Robot,
        crossed: Callable[[], Sequence[Span]] = tuple,
    ) -> None:
        super().__init__(plant)
        self._scenario, self._limits, self._crossed = scenario, robot.limits, crossed
        self._faults = SensorFaults(scenario, WheelKinematics(robot.wheel_radius, robot.track))
        self.reset(np.zeros(3))

    @property
    def scenario(self) -> Scenario:
        """The scenario with the values of this run."""
        return self._scenario

    @property
    def disturbance(self) -> Span | None:
        """When the first disturbance so far began, and when the last so far was over [s]; None where none has begun.

        One that lasts to the end of the run is never over: where all of them do, the second number is infinite.
        """
        begun = [span for span in (*self._scenario.spans, *self._crossed()) if span[0] <= self.time]
        if not begun:
            return None
        ends = [end for _, end in begun if math.isfinite(end)]
        return min(start for start, _ in begun), min(self.time, max(ends)) if ends else math.inf

    def reset(self, pose: ArrayLike) -> None:
        """Put the robot at rest beside `pose` (3,) by the start offset, at time 0, and restart the noise."""
        start = np.array(pose, dtype=float)
        offset = self._scenario.start_offset
        if offset is not None:
            c, s = np.cos(start[2]), np.sin(start[2])
            start += [c * offset.along - s * offset.across, s * offset.along + c * offset.across, offset.heading]
        self._sent: tuple[float, float] | None = None
        self._faults.reset()
        self._plant.reset(start)

    def measure(self) -> Measurement:
        """Everything that the sensors delivered since the last call, with their faults."""
        return replace(self._faults.apply(self._plant.measure(), self.time), sent=self._sent)

    def advance(self, command: ArrayLike) -> None:
        """Send `command` (2,), or a false one in its place, and let one sample pass; raises ValueError as any plant."""
        sent = clip_command(command, self._limits)
        false = [item for item in self._scenario.false_commands if item.holds(self.time)]
        self._plant.advance([false[-1].v, false[-1].omega] if false else sent)
        self._sent = (float(sent[0]), float(sent[1]))
