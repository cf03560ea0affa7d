"""One subject's closed loop: plant, what the subject is told at each tick, and what it answered."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from diffdrive_mpc.bench.counters import Effort
from diffdrive_mpc.bench.peers.tracking_peer import nearest_command
from diffdrive_mpc.models.interface import FloatArray, Measurement, Reference
from diffdrive_mpc.models.velocity_model import VelocityModel
from diffdrive_mpc.mpc import Controller, load_trajectory
from diffdrive_mpc.mpc.config.schema import ControllerConfig
from diffdrive_mpc.sim import make_plant
from studies.speed.process.subject import Subject, TimedStep
from studies.speed.settings import SpeedSettings
from studies.speed.stage import stage_data


class PeerInput:
    """What peers are told: estimate, reference and feed-forward of our own controller, none of it on their clock."""

    def __init__(self, config: ControllerConfig, model: VelocityModel, reference: Reference) -> None:
        self._config, self._reference = config, reference
        self._controller = Controller(config)
        memory = model.discretise(config.sample_time).memory
        self._past = np.zeros((memory, 2))
        self._started = False

    def data(self, t: float, measurement: Measurement) -> tuple[FloatArray, FloatArray]:
        """State of the first stage and parameters of all, see `studies.speed.stage`, at `t` [s]."""
        if not self._started:
            self._controller.start(self._reference, t)
        # What the subject commanded, not what this controller would have.
        sent = (float(self._past[-1, 0]), float(self._past[-1, 1]))
        stamped = replace(measurement, sent=sent) if self._started else measurement
        self._started = True
        self._controller.program.count_from(self._past[-1])
        estimate = self._controller.step(t, stamped).estimate
        if estimate is None:
            raise RuntimeError("the drive begins without a pose: peers cannot be told where the robot is")
        return stage_data(self._controller.program, estimate, self._past)

    def sent(self, command: FloatArray) -> FloatArray:
        """What is sent for a peer's `command` (2,): as with ours, the nearest inside range and slew."""
        sent = nearest_command(command, self._config.limits, self._config.sample_time, self._past[-1])
        self._past = np.concatenate([self._past[1:], sent[None]])
        return sent


@dataclass
class ClosedLoop:
    """A closed loop that goes on tick by tick.

    Attributes
    ----------
    ticks, peer_data
        What the subject was told at each tick, for a replay; and what a peer would have been told there.
    steps, efforts
        What it said, and what that took of its process.
    pose, twist, command
        True pose (3,) and twist (2,) before each tick, and the command sent (2,).
    """

    config: ControllerConfig
    model: VelocityModel
    settings: SpeedSettings
    subject: Subject
    ours: bool
    ticks: list[tuple[Any, ...]] = field(default_factory=list)
    peer_data: list[tuple[FloatArray, FloatArray]] = field(default_factory=list)
    steps: list[TimedStep] = field(default_factory=list)
    efforts: list[Effort] = field(default_factory=list)
    pose: list[FloatArray] = field(default_factory=list)
    twist: list[FloatArray] = field(default_factory=list)
    command: list[FloatArray] = field(default_factory=list)

    def __post_init__(self) -> None:
        """Put the robot at the start of the reference."""
        s = self.settings
        self.reference = load_trajectory(s.trajectory)
        self._plant = make_plant(f"model:{self.config.model}", sensors=s.plant_sensors, seed=s.seed)
        self._plant.reset(self.reference.sample([0.0]).pose[0])
        self._input = PeerInput(self.config, self.model, self.reference)

    def step(self) -> None:
        """One tick."""
        plant = self._plant
        t, measurement = plant.time, plant.measure()
        peer_data = self._input.data(t, measurement)
        data = (t, measurement) if self.ours else peer_data
        if not self.ticks:
            self.subject.reset(data)
        (step,), effort = self.subject.run([data])
        command = np.array(step.command)
        if not np.isfinite(command).all():
            command = np.zeros(2)
        command = self._input.sent(command)
        self.ticks.append(data)
        self.peer_data.append(peer_data)
        self.steps.append(step)
        self.efforts.append(effort)
        self.pose.append(plant.true_pose)
        self.twist.append(plant.true_twist[[0, 2]])
        self.command.append(command)
        plant.advance(command)
