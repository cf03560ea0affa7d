"""Estimate pose, twist and velocity offset from measurements that arrive at several rates and late.

A short history of beliefs is kept. A late measurement is entered at its stamp and everything after it is computed
again, so that it counts as if it had come in time.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from models.discrete_model import DiscreteModel
from models.interface import FloatArray, Measurement
from mpc.command_line import CommandLine
from mpc.config import Estimator
from mpc.kalman import Belief, VelocityPoseFilter
from mpc.measurement_check import numbers
from mpc.pose_gate import CheckedPose, PoseGate
from mpc.twist_gate import CheckedTwist, TwistGate


@dataclass(frozen=True)
class Estimate:
    """What the controller believes at one tick.

    Attributes
    ----------
    time
        Time of the tick [s].
    pose
        (3,) x [m], y [m], theta [rad, unwrapped].
    twist
        (2,) v [m/s], omega [rad/s], offset included.
    offset
        (2,) part of the twist that the model does not explain [m/s, rad/s].
    state
        (n,) states of the velocity model.
    pose_deviation, offset_deviation
        (3,) and (2,) standard deviations.
    pose_age
        Time since the stamp of the last accepted pose [s].
    """

    time: float
    pose: FloatArray
    twist: FloatArray
    offset: FloatArray
    state: FloatArray
    pose_deviation: FloatArray
    offset_deviation: FloatArray
    pose_age: float


@dataclass
class _Node:
    """One tick of the history: the belief before and after its measurements."""

    time: float
    prior: Belief
    posterior: Belief
    twists: list[CheckedTwist] = field(default_factory=list)
    poses: list[CheckedPose] = field(default_factory=list)


class StateEstimator:
    """Extended Kalman filter with a history; never raises on data.

    Parameters
    ----------
    model
        The sampled velocity model with its dead time.
    settings
        Noise, history and rejection limits.
    """

    def __init__(self, model: DiscreteModel, settings: Estimator) -> None:
        self._model = model
        self._settings = settings
        self._length = int(np.ceil(settings.history / model.dt)) + 1
        self._filter = VelocityPoseFilter(model, settings)
        self._poses = PoseGate(settings)
        self._twists = TwistGate(settings)
        self.commands = CommandLine(model, self._length)
        self.forget()

    def forget(self) -> None:
        """Drop the estimate, as before the first pose. Commands on their way stay: they are still on their way."""
        self._nodes: list[_Node] = []
        self._poses.reset()
        self._twists.reset()

    @property
    def ready(self) -> bool:
        """Whether there is an estimate: a pose has been received."""
        return bool(self._nodes)

    @property
    def moved(self) -> bool:
        """Whether poses agree with each other but not with the estimate: the robot is somewhere else."""
        return self._poses.elsewhere is not None

    @property
    def longest_pause(self) -> float:
        """Time without a tick [s] that the history can make up for."""
        return self._length * self._model.dt

    @property
    def estimate(self) -> Estimate:
        """The newest estimate; only once `ready`."""
        node, n = self._nodes[-1], self._model.order
        mean = node.posterior.mean
        deviation = np.sqrt(np.maximum(np.diag(node.posterior.covariance), 0.0))
        return Estimate(
            time=node.time,
            pose=mean[n + 2 :].copy(),
            twist=self._filter.twist(mean),
            offset=mean[n : n + 2].copy(),
            state=mean[:n].copy(),
            pose_deviation=deviation[n + 2 :],
            offset_deviation=deviation[n : n + 2],
            pose_age=node.time - self._poses.accepted_stamp,
        )

    def correct_sent(self, sent: tuple[float, float] | None) -> list[str]:
        """Believe what the robot says it got at the last tick, unless it cannot be; then returns why not."""
        if sent is None:
            return []
        value = numbers(sent, 2)
        largest = [self._settings.max_wheel_speed, self._settings.max_yaw_rate]
        if value is None or (np.abs(value) > largest).any():
            return ["sent command rejected: it is not one that a robot can have got"]
        self.commands.correct_last(value)
        return []

    def advance(self, t: float) -> None:
        """Predict to the tick at `t` [s], not more than `longest_pause` after the last one.

        The commands of the ticks since are in `commands`; ticks that were missed are made up for with the last one.
        """
        if not self._nodes:
            return
        steps = max(1, round((t - self._nodes[-1].time) / self._model.dt))
        for missing in range(steps - 1, -1, -1):
            if missing < steps - 1:
                self.commands.append(self.commands.last)
            belief = self._filter.predict(self._nodes[-1].posterior, *self.commands.acting(0))
            self._nodes.append(_Node(t - missing * self._model.dt, belief, belief))
        del self._nodes[: -self._length]

    def update(self, t: float, measurement: Measurement) -> list[str]:
        """Take in what arrived; returns a sentence for each part that was rejected."""
        rejected: list[str] = []
        pose = self._poses.check(t, measurement.pose, rejected)
        twists = self._twists.check(t, measurement, rejected)
        if not self._nodes:
            if pose is not None:
                self._start(t, pose, self._filter.moving(self.commands))
            return rejected
        first = len(self._nodes)
        for twist in twists:
            # At the nearest tick: within half a sample a twist changes little.
            index = self._node_before(twist.stamp + 0.5 * self._model.dt)
            self._nodes[index].twists.append(twist)
            first = min(first, index)
        if pose is not None:
            index = self._node_before(pose.stamp)
            node = self._nodes[index]
            if self._poses.passes(pose, self._filter.pose_at(node.posterior, pose.stamp - node.time), rejected):
                node.poses.append(pose)
                first = min(first, index)
        self._filter_from(first)
        return rejected

    def restart_elsewhere(self) -> bool:
        """Believe that the robot is where the poses that jumped agree it is. Its motion stays as estimated."""
        pose = self._poses.elsewhere
        if pose is None:
            return False
        self._start(self._nodes[-1].time, pose, self._nodes[-1].posterior)
        return True

    def _start(self, t: float, pose: CheckedPose, motion: Belief) -> None:
        belief = self._filter.placed(motion, pose.value, pose.covariance)
        self._nodes = [_Node(t, belief, belief)]
        self._poses.accept(pose)

    def _node_before(self, time: float) -> int:
        """Index of the last node not after `time`; the first where the history does not reach back so far."""
        for index in range(len(self._nodes) - 1, 0, -1):
            if self._nodes[index].time <= time + 1e-9:
                return index
        return 0

    def _filter_from(self, first: int) -> None:
        """Filter again from the node `first` to the newest."""
        newest = len(self._nodes) - 1
        for index in range(first, newest + 1):
            node = self._nodes[index]
            if index > first:
                ticks_ago = newest - index
                node.prior = self._filter.predict(self._nodes[index - 1].posterior, *self.commands.acting(ticks_ago))
            belief = node.prior
            if node.twists:
                belief = self._filter.correct_twist(
                    belief,
                    np.array([twist.value for twist in node.twists]),
                    np.array([twist.variance for twist in node.twists]),
                    [twist.row for twist in node.twists],
                )
            for pose in node.poses:
                belief = self._filter.correct_pose(belief, pose.value, pose.covariance, pose.stamp - node.time)
            node.posterior = belief
