"""Estimate pose, twist and slip from measurements that arrive at several rates and late.

A short history of beliefs is kept. A late measurement is entered at its stamp and everything after it is computed
again, so that it counts as if it had come in time.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from diffdrive_mpc.models.discrete_model import DiscreteModel
from diffdrive_mpc.models.interface import Measurement
from diffdrive_mpc.mpc.belief import Belief
from diffdrive_mpc.mpc.command_line import CommandLine
from diffdrive_mpc.mpc.config.schema import Compensation, Estimator, Wheels
from diffdrive_mpc.mpc.estimate import SENSORS, Estimate
from diffdrive_mpc.mpc.kalman import SlipFilter
from diffdrive_mpc.mpc.measurement_check import numbers
from diffdrive_mpc.mpc.pose_gate import CheckedPose, PoseGate
from diffdrive_mpc.mpc.twist_gate import CheckedTwist, TwistGate

TOO_MANY = "more arrived for one sample than is kept"
_SENT_REJECTED = "sent command rejected: it is not one that a robot can have got"
# What one tick of the history holds at most: numbers of wheels and gyro, and poses.
_MOST_TWISTS, _MOST_POSES = 12, 4


def history_ticks(settings: Estimator, dt: float) -> int:
    """Ticks that the history holds."""
    return int(np.ceil(settings.history / dt)) + 1


def build_filter(
    model: DiscreteModel, settings: Estimator, compensation: Compensation | None, wheels: Wheels | None
) -> SlipFilter:
    """The Kalman filter; see `StateEstimator` for the parameters."""
    wheels = wheels or Wheels()
    # Per unit of omega_ref the wheels turn with the ratio of the tracks, and the model with its steady gain.
    ratio = wheels.track / wheels.encoder_track / float(model.dc_gain[1, 1])
    return SlipFilter(model, settings, compensation or Compensation(), ratio)


def correct_sent(commands: CommandLine, sent: tuple[float, float] | None, settings: Estimator) -> list[str]:
    """Put what the robot says it got at the last tick into `commands`, unless it cannot be; then returns why not."""
    if sent is None:
        return []
    value = numbers(sent, 2)
    if value is not None:
        v, omega = value.tolist()
        if abs(v) <= settings.max_wheel_speed and abs(omega) <= settings.max_yaw_rate:
            commands.correct_last(value)
            return []
    return [_SENT_REJECTED]


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
    compensation
        What is estimated; by default all of it.
    wheels
        Tracks of firmware and encoders.
    """

    def __init__(
        self,
        model: DiscreteModel,
        settings: Estimator,
        compensation: Compensation | None = None,
        wheels: Wheels | None = None,
    ) -> None:
        self._model = model
        self._settings = settings
        self._length = history_ticks(settings, model.dt)
        self._filter = build_filter(model, settings, compensation, wheels)
        self._corrections = {
            "wheel_speed": self._filter.correct_wheel_speed,
            "wheel_yaw_rate": self._filter.correct_wheel_yaw_rate,
            "yaw_rate": self._filter.correct_yaw_rate,
        }
        self._poses = PoseGate(settings)
        self._twists = TwistGate(settings)
        self.commands = CommandLine(model, self._length)
        self.forget()

    def forget(self) -> None:
        """Drop the estimate, as before the first pose. Commands on their way stay: they are still on their way."""
        self._nodes: list[_Node] = []
        self._innovations: dict[str, float] = {}
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
        node = self._nodes[-1]
        belief = node.posterior
        deviation = np.sqrt(np.maximum(np.diag(belief.covariance), 0.0))
        values = np.concatenate(
            [
                [node.time, node.time - self._poses.accepted_stamp],
                belief.mean,
                deviation,
                self._filter.twist(belief.mean),
                self._filter.twist_deviation(belief),
                [self._innovations.get(sensor, np.nan) for sensor in SENSORS],
            ]
        )
        return Estimate(values, self._model.order)

    def correct_sent(self, sent: tuple[float, float] | None) -> list[str]:
        """Believe what the robot says it got at the last tick, unless it cannot be; then returns why not."""
        return correct_sent(self.commands, sent, self._settings)

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
            if len(self._nodes[index].twists) == _MOST_TWISTS:
                rejected.append(f"{twist.message} rejected: {TOO_MANY}")
                continue
            self._nodes[index].twists.append(twist)
            first = min(first, index)
        if pose is not None:
            index = self._node_before(pose.stamp)
            node = self._nodes[index]
            if len(node.poses) == _MOST_POSES:
                rejected.append(f"pose rejected: {TOO_MANY}")
            elif self._poses.passes(pose, self._filter.pose_at(node.posterior, pose.stamp - node.time), rejected):
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
            belief, seen = node.prior, self._innovations
            for twist in node.twists:
                correct = self._corrections[twist.sensor]
                belief, seen[twist.sensor] = correct(belief, twist.value, twist.variance)
            for pose in node.poses:
                ahead = pose.stamp - node.time
                belief, seen["pose"] = self._filter.correct_pose(belief, pose.value, pose.covariance, ahead)
            node.posterior = belief
