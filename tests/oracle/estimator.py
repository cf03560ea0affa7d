"""Estimation of pose, twist and slip from measurements with different rates and delays.

A late measurement is inserted into the stored history at its stamp, and all later states are computed again, so that
its delay has no effect on the estimate.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from diffdrive_mpc.models.discrete_model import DiscreteModel
from diffdrive_mpc.models.interface import FloatArray, Measurement
from diffdrive_mpc.mpc.config.schema import Compensation, Estimator, SensorResponses, Wheels
from diffdrive_mpc.mpc.estimate import SENSORS
from oracle.checks import CheckedPose, CheckedTwist, PoseGate, PoseRate, TwistGates, sent_command
from oracle.commands import PastCommands
from oracle.estimate import Estimate
from oracle.kalman import Belief, build_filter

_TOO_MANY = "too many arrived for one sample: send fewer"
# Capacity of one tick of the history: values of wheels and gyro, and poses.
_MAX_TWISTS, _MAX_POSES = 12, 4


@dataclass
class _Node:
    """One tick of the history: the state distribution before and after its measurements."""

    time: float
    prior: Belief
    posterior: Belief
    twists: list[CheckedTwist] = field(default_factory=list)
    poses: list[CheckedPose] = field(default_factory=list)


class StateEstimator:
    """Extended Kalman filter with a history; invalid data raise no errors."""

    def __init__(
        self,
        model: DiscreteModel,
        settings: Estimator,
        compensation: Compensation | None = None,
        wheels: Wheels | None = None,
        max_pose_age: float = math.inf,
        sensors: SensorResponses | None = None,
    ) -> None:
        self.sensors = sensors or SensorResponses()
        self.model, self.settings, self.max_pose_age = model, settings, max_pose_age
        self.length = int(np.ceil(settings.history / model.dt)) + 1
        self.filter = build_filter(model, settings, compensation, wheels)
        self.commands = PastCommands(model, self.length, self.filter.spare)
        self.forget()

    def forget(self) -> None:
        """Reset the estimate to the state before the first pose; keep the commands, because some still act."""
        self.nodes: list[_Node] = []
        self.innovations = dict.fromkeys(SENSORS, np.nan)
        self.rate = PoseRate(self.model.dt, self.max_pose_age, self.settings.history)
        self.pose_gate = PoseGate(self.settings, self.rate, self.sensors.pose)
        self.twist_gates = TwistGates(self.settings, self.sensors)

    @property
    def ready(self) -> bool:
        """True if an estimate exists, that is, a pose has been received."""
        return bool(self.nodes)

    @property
    def moved(self) -> bool:
        """True if poses agree with each other but not with the estimate: the robot was moved."""
        return self.pose_gate.elsewhere is not None

    @property
    def max_pause(self) -> float:
        """Time without a tick [s] that the history can bridge."""
        return self.length * self.model.dt

    @property
    def estimate(self) -> Estimate:
        """Newest estimate; available once `ready`."""
        node = self.nodes[-1]
        belief = node.posterior
        mean = self.filter.weighed(belief)
        values = [
            [node.time, node.time - self.pose_gate.accepted_stamp],
            mean,
            np.sqrt(np.maximum(np.diag(belief.covariance), 0.0)),
            self.filter.twist(belief.mean),
            self.filter.twist_deviation(belief),
            list(self.innovations.values()),
        ]
        return Estimate(np.concatenate(values), self.model.order)

    def correct_sent(self, sent: tuple[float, float] | None, max_command: FloatArray) -> list[str]:
        """Use the reported command of the last tick, up to `max_command` (2,); return a message if it is rejected."""
        if sent is None:
            return []
        value = sent_command(sent, max_command)
        if value is None:
            return ["sent command rejected: it is not two finite numbers, or exceeds the command limits"]
        self.commands.correct_last(value)
        return []

    def advance(self, t: float) -> None:
        """Predict to the tick at `t` [s]; missed ticks use the last command."""
        if not self.nodes:
            return
        steps = max(1, round((t - self.nodes[-1].time) / self.model.dt))
        for missing in range(steps - 1, -1, -1):
            if missing < steps - 1:
                self.commands.append(self.commands.last)
            belief = self.filter.predict(self.nodes[-1].posterior, self.commands.acting(0))
            self.nodes.append(_Node(t - missing * self.model.dt, belief, belief))
        self.nodes = self.nodes[-self.length :]

    def update(self, t: float, measurement: Measurement) -> list[str]:
        """Process a measurement; return a sentence for each rejected part."""
        rejected: list[str] = []
        self.pose_gate.now = self.nodes[-1].time if self.nodes else t
        pose = self.pose_gate.check(t, measurement.pose, rejected)
        twists = self.twist_gates.check(t, measurement, rejected)
        if not self.nodes:
            if pose is not None:
                self._start(t, pose, self.filter.moving(self.commands))
            return rejected
        first = len(self.nodes)
        for twist in twists:
            half = 0.5 * self.model.dt
            index = self._node_before(twist.stamp + half)
            if twist.stamp < self.nodes[index].time - half - 1e-9:
                continue  # older than the history
            if len(self.nodes[index].twists) == _MAX_TWISTS:
                rejected.append(f"{twist.message} rejected: {_TOO_MANY}")
            else:
                self.nodes[index].twists.append(twist)
                first = min(first, index)
        if pose is not None:
            index = self._node_before(pose.true_at)
            node = self.nodes[index]
            is_before = pose.true_at < node.time - 1e-9
            if len(node.poses) >= _MAX_POSES - is_before:
                rejected += [] if is_before else [f"pose rejected: {_TOO_MANY}"]
            elif self.pose_gate.passes(pose, self.filter.pose(node.posterior.mean, pose.true_at - node.time), rejected):
                node.poses.append(pose)
                first = min(first, index)
        self._filter_from(first)
        return rejected

    def restart_elsewhere(self) -> bool:
        """Restart at the position of the agreeing rejected poses, with the estimated motion."""
        pose = self.pose_gate.elsewhere
        if pose is not None:
            self._start(self.nodes[-1].time, pose, self.nodes[-1].posterior)
        return pose is not None

    def _start(self, t: float, pose: CheckedPose, motion: Belief) -> None:
        belief = self.filter.placed(motion, pose.value, pose.covariance)
        self.nodes = [_Node(t, belief, belief)]
        self.pose_gate.accept(pose)

    def _node_before(self, time: float) -> int:
        """Return the index of the last node not after `time`, or the first if the history is too short."""
        return max((i for i, node in enumerate(self.nodes) if node.time <= time + 1e-9), default=0)

    def _filter_from(self, first: int) -> None:
        """Filter again from the node `first` to the newest."""
        for index in range(first, len(self.nodes)):
            node = self.nodes[index]
            if index > first:
                acting = self.commands.acting(len(self.nodes) - 1 - index)
                node.prior = self.filter.predict(self.nodes[index - 1].posterior, acting)
            belief, innovations = node.prior, self.innovations
            for twist in node.twists:
                ahead = twist.stamp - node.time
                belief, innovations[twist.sensor] = self.filter.correct(
                    belief, twist.sensor, twist.value, twist.variance, ahead
                )
            for pose in node.poses:
                ahead = pose.true_at - node.time
                belief, innovations["pose"] = self.filter.correct_pose(belief, pose.value, pose.covariance, ahead)
            node.posterior = belief
