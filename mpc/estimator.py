"""Estimate pose, twist and velocity offset from measurements that arrive at several rates and late.

A short history of beliefs is kept. A late measurement is entered at its stamp and everything after it is computed
again, so that it counts as if it had come in time.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from models.discrete_model import DiscreteModel
from models.interface import FloatArray, Measurement, Stamped
from models.pose import wrap_angle
from mpc.command_line import CommandLine
from mpc.config import Estimator
from mpc.kalman import Belief, VelocityPoseFilter

# Clocks of one robot agree to better than this; a stamp further ahead of the tick is a fault.
_FUTURE = 1e-3


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
    twists: list[tuple[int, float, float]] = field(default_factory=list)
    """(row, value, variance): v is row 0, omega row 1."""
    poses: list[tuple[FloatArray, FloatArray, float]] = field(default_factory=list)
    """(pose, covariance, time after the node)."""


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
        self._pose_covariance = np.diag(
            np.square([settings.position_noise, settings.position_noise, settings.heading_noise])
        )
        self.commands = CommandLine(model, self._length)
        self.reset()

    def reset(self) -> None:
        """Forget everything, as before the first pose."""
        self._nodes: list[_Node] = []
        self._pose_stamp = -np.inf
        self._suspect: FloatArray | None = None
        self._candidate: tuple[float, FloatArray] | None = None
        self.commands.clear()

    @property
    def ready(self) -> bool:
        """Whether a pose has been received."""
        return bool(self._nodes)

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
            pose_age=node.time - self._pose_stamp,
        )

    def correct_sent(self, sent: tuple[float, float] | None) -> list[str]:
        """Believe what the robot says it got at the last tick, unless it cannot be; then returns why not."""
        if sent is None:
            return []
        value = np.asarray(sent, dtype=float)
        largest = [self._settings.max_wheel_speed, self._settings.max_yaw_rate]
        # Not a comparison the other way round: NaN fails every one.
        if not (value.shape == (2,) and (np.abs(value) <= largest).all()):
            return [f"sent command rejected: {value.tolist()} is beyond what a robot can do"]
        self.commands.correct_last(value)
        return []

    def advance(self, t: float) -> str | None:
        """Predict to the tick at `t` [s]; the commands of the ticks since are in `commands`.

        Ticks that were missed are made up for with the last command. After a pause longer than the history the
        estimate is dropped, and the reason returned.
        """
        if not self._nodes:
            return None
        pause = t - self._nodes[-1].time
        steps = max(1, round(pause / self._model.dt))
        if steps > self._length:
            last = self.commands.last
            self.reset()
            self.commands.append(last)
            return f"no tick for {pause:.2f} s; the estimate starts anew"
        for missing in range(steps - 1, -1, -1):
            if missing < steps - 1:
                self.commands.append(self.commands.last)
            belief = self._filter.predict(self._nodes[-1].posterior, *self.commands.acting(0))
            self._nodes.append(_Node(t - missing * self._model.dt, belief, belief))
        del self._nodes[: -self._length]
        return None

    def update(self, t: float, measurement: Measurement) -> list[str]:
        """Take in what arrived; returns a sentence for each part that was rejected."""
        rejected: list[str] = []
        pose = self._checked_pose(t, measurement.pose, rejected)
        if not self._nodes:
            if pose is not None:
                self._start(t, pose)
            return rejected
        oldest = len(self._nodes)
        settings = self._settings
        for row, name, stamped, noise, largest in (
            (0, "wheel speed", measurement.wheel_twist, settings.wheel_speed_noise, settings.max_wheel_speed),
            (1, "yaw rate", measurement.yaw_rate, settings.yaw_rate_noise, settings.max_yaw_rate),
        ):
            if stamped is None:
                continue
            value, variance = _first_entry(stamped, noise**2)
            index = self._node_before(stamped.time + 0.5 * self._model.dt)
            if not (abs(value) <= largest and 0 < variance < np.inf):
                rejected.append(f"{name} rejected: {value} with variance {variance}; the limit is {largest}")
            elif index is None or stamped.time > t + _FUTURE:
                rejected.append(f"{name} rejected: stamped {t - stamped.time:.3f} s before the tick")
            else:
                self._nodes[index].twists.append((row, value, variance))
                oldest = min(oldest, index)
        if pose is not None:
            oldest = min(oldest, self._enter_pose(pose, rejected))
        self._filter_from(oldest)
        return rejected

    def restart_from_candidate(self, t: float) -> bool:
        """Accept the place where rejected poses agree the robot is; only sensible while it stands still."""
        if self._candidate is None or t - self._candidate[0] > self._settings.history:
            return False
        stamp, pose = self._candidate
        self._start(t, Stamped(pose, stamp))
        return True

    def _start(self, t: float, pose: Stamped) -> None:
        value = np.asarray(pose.value, dtype=float)
        belief = self._filter.at_rest(value, self._covariance(pose))
        self._nodes = [_Node(t, belief, belief)]
        self._pose_stamp = pose.time
        self._candidate = None

    def _checked_pose(self, t: float, pose: Stamped | None, rejected: list[str]) -> Stamped | None:
        if pose is None:
            return None
        value = np.asarray(pose.value, dtype=float)
        reason = ""
        if value.shape != (3,) or not (np.isfinite(value).all() and np.isfinite(pose.time)):
            reason = "not three finite numbers with a finite stamp"
        elif not _is_covariance(pose.covariance):
            reason = "its covariance is not a positive definite 3 x 3 matrix"
        elif pose.time > t + _FUTURE:
            reason = f"its stamp lies {pose.time - t:.3f} s in the future"
        elif pose.time <= self._pose_stamp:
            reason = "its stamp is not newer than that of the pose before"
        elif t - pose.time > self._settings.history:
            reason = f"it is {t - pose.time:.2f} s old; the history reaches back {self._settings.history} s"
        if reason:
            rejected.append(f"pose rejected: {reason}")
            return None
        return pose

    def _enter_pose(self, pose: Stamped, rejected: list[str]) -> int:
        """Put a checked pose into the history; returns the node from which to filter again."""
        index = self._node_before(pose.time)
        if index is None:
            rejected.append("pose rejected: it is older than the estimate")
            return len(self._nodes)
        node, value = self._nodes[index], np.asarray(pose.value, dtype=float)
        ahead = max(pose.time - node.time, 0.0)
        if self._is_jump(value, self._filter.pose_at(node.posterior, ahead)):
            self._remember(pose.time, value)
            expected = self._filter.pose_at(node.posterior, ahead)
            distance = float(np.hypot(*(value - expected)[:2]))
            turn = abs(float(wrap_angle(value[2] - expected[2])))
            rejected.append(f"pose rejected: it jumps by {distance:.2f} m and {turn:.2f} rad")
            return len(self._nodes)
        self._pose_stamp, self._candidate = pose.time, None
        node.poses.append((value, self._covariance(pose), ahead))
        return index

    def _remember(self, stamp: float, value: FloatArray) -> None:
        """Keep a rejected pose; the second of two that agree becomes the candidate for a restart."""
        agrees = self._suspect is not None and not self._is_jump(value, self._suspect)
        self._suspect = value
        self._candidate = (stamp, value) if agrees else None

    def _is_jump(self, value: FloatArray, expected: FloatArray) -> bool:
        difference = value - expected
        too_far = np.hypot(difference[0], difference[1]) > self._settings.max_position_jump
        return bool(too_far or abs(wrap_angle(difference[2])) > self._settings.max_heading_jump)

    def _covariance(self, pose: Stamped) -> FloatArray:
        return self._pose_covariance if pose.covariance is None else np.asarray(pose.covariance, dtype=float)

    def _node_before(self, time: float) -> int | None:
        """Index of the last node not after `time`, or None if the history does not reach back to it."""
        for index in range(len(self._nodes) - 1, -1, -1):
            if self._nodes[index].time <= time + 1e-9:
                return index
        return None

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
                rows, values, variances = zip(*node.twists, strict=True)
                belief = self._filter.correct_twist(belief, np.array(values), np.array(variances), list(rows))
            for pose, covariance, ahead in node.poses:
                belief = self._filter.correct_pose(belief, pose, covariance, ahead)
            node.posterior = belief


def _first_entry(stamped: Stamped, variance: float) -> tuple[float, float]:
    """First entry of the value and its variance: a sensor's own if it states one."""
    value = float(np.ravel(stamped.value)[0])
    if stamped.covariance is not None:
        variance = float(np.ravel(stamped.covariance)[0])
    return value, variance


def _is_covariance(covariance: object) -> bool:
    if covariance is None:
        return True
    matrix = np.asarray(covariance, dtype=float)
    return bool(matrix.shape == (3, 3) and np.isfinite(matrix).all() and np.linalg.eigvalsh(matrix).min() > 0)
