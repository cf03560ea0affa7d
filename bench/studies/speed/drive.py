"""One subject's closed loop: plant, what the subject is told at each tick, and what it answered."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from diffdrive_mpc.bench.studies.speed.process.subject import Subject, TimedStep
from diffdrive_mpc.bench.studies.speed.settings import SpeedSettings
from diffdrive_mpc.bench.studies.speed.stage import stage_data
from diffdrive_mpc.models.interface import FloatArray, Measurement, Reference
from diffdrive_mpc.models.velocity_model import VelocityModel
from diffdrive_mpc.mpc import load_trajectory
from diffdrive_mpc.mpc.bounds import clip_command
from diffdrive_mpc.mpc.config.schema import ControllerConfig
from diffdrive_mpc.mpc.estimator import StateEstimator
from diffdrive_mpc.mpc.planner import Planner
from diffdrive_mpc.mpc.problem import TrackingProblem
from diffdrive_mpc.sim import make_plant


class PeerInput:
    """What peers are told: estimate, reference and feed-forward of our own controller, none of it on their clock."""

    def __init__(self, config: ControllerConfig, model: VelocityModel, reference: Reference) -> None:
        sampled = model.discretise(config.sample_time)
        self._config, self._reference = config, reference
        self._estimator = StateEstimator(sampled, config.estimator, config.compensation, config.wheels)
        self._planner = Planner(config, model)
        self._problem = TrackingProblem(config, sampled)

    def data(self, t: float, measurement: Measurement) -> tuple[FloatArray, FloatArray]:
        """State of the first stage and parameters of all, see `bench.studies.speed.stage`, at `t` [s]."""
        estimator = self._estimator
        estimator.correct_sent(measurement.sent)
        estimator.advance(t)
        estimator.update(t, measurement)
        past, estimate = estimator.commands.recent, estimator.estimate
        tick = self._planner.tick(estimate, past, past[-1], self._reference, t)
        return stage_data(self._problem, tick, estimate.state, estimate.slip.offset, past)

    def sent(self, command: FloatArray) -> FloatArray:
        """What is sent for a peer's `command` (2,): as with ours, the nearest inside range and slew."""
        limits, dt = self._config.limits, self._config.sample_time
        sent = clip_command(command, limits, dt, self._estimator.commands.last)
        self._estimator.commands.append(sent)
        return sent


@dataclass
class Drive:
    """A closed loop that goes on tick by tick.

    Attributes
    ----------
    ticks, peer_data
        What the subject was told at each tick, for a replay; and what a peer would have been told there.
    steps
        What it said.
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
        (step,) = self.subject.run([data])
        command = np.array(step.command)
        if not np.isfinite(command).all():
            command = np.zeros(2)
        command = self._input.sent(command)
        self.ticks.append(data)
        self.peer_data.append(peer_data)
        self.steps.append(step)
        self.pose.append(plant.true_pose)
        self.twist.append(plant.true_twist[[0, 2]])
        self.command.append(command)
        plant.advance(command)
