"""Common parts of all peers: estimate, prediction and command limits around a tracking law."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Protocol

import numpy as np
from pydantic import Field

from diffdrive_mpc.bench.peers import PeerStep, TrackingLaw, find_peer
from diffdrive_mpc.bench.peers.estimator import DelayPredictor, HeldEstimator, PredictedMotion
from diffdrive_mpc.models.checked_yaml import ConfigError, StrictModel, check, read_yaml
from diffdrive_mpc.models.interface import FloatArray, Measurement, Reference
from diffdrive_mpc.models.load import load_linear_model
from diffdrive_mpc.models.pose import ahead_and_left, wrap_angle
from diffdrive_mpc.models.two_sided import reached
from diffdrive_mpc.mpc import ControllerConfig, load_config
from diffdrive_mpc.mpc.config.schema import Limits
from diffdrive_mpc.mpc.estimate import Estimate
from diffdrive_mpc.mpc.problem.formulas import formula
from diffdrive_mpc.mpc.problem.slip import Slip

# Command limits of peers: range and slew, applied as the core does for the predictive controller.


def slew_step(limits: Limits, dt: float) -> FloatArray:
    """Compute the maximum change (2,) of the command per tick within both sides of the slew [m/s, rad/s]."""
    return np.array([limits.v_slew, limits.omega_slew]) * dt


def nearest_command(command: FloatArray, limits: Limits, dt: float, last: FloatArray) -> FloatArray:
    """Return the nearest command (2,) inside the range, and reachable from `last` (2,) within the slew limits."""
    upper, lower = np.transpose([limits.v.sides, limits.omega.sides])
    grows, falls = np.transpose([limits.v_slew.sides, limits.omega_slew.sides]) * dt
    return reached(last, np.clip(command, -lower, upper), grows, falls)


STANDING = 0.01
"""Speed below which a reference counts as standing or turning on the spot [m/s]."""
MODEL = "sm"
"""Configuration and model of every peer: the one that separates dead time and lag."""

NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
AboveZero = Annotated[float, Field(gt=0, allow_inf_nan=False)]


class Gains(StrictModel):
    """Tuned gains of a peer's law, and its lead."""

    lead: NotNegative = Field(0.0, description="prediction time of the pose that the law acts on [s]")


@dataclass(frozen=True, slots=True)
class LawInput:
    """Input of a law at one tick; all values belong to the time at which its command takes effect.

    Attributes
    ----------
    time
        Time since the start of the reference [s].
    motion
        Predicted pose (3,) and twist (2,). With compensation of side-slip, the heading is the direction of travel.
    reference
        (3,) pose of the reference; its heading is unwrapped to within pi of the robot's heading.
    feed_forward
        (2,) twist of the reference, each channel ahead by its lag [m/s, rad/s].
    """

    time: float
    motion: PredictedMotion
    reference: FloatArray
    feed_forward: FloatArray

    @property
    def error(self) -> FloatArray:
        """(3,) from robot to reference in the robot's frame: ahead [m], to the left [m], turned left [rad]."""
        gap = self.reference - self.motion.pose
        return np.array([*ahead_and_left(gap, self.motion.pose[2]), gap[2]])


@dataclass(frozen=True)
class Delayed:
    """Parameters of the robot that a law may use in addition to the prediction.

    Attributes
    ----------
    sample_time
        Period of the ticks [s].
    time_constant
        (2,) lag of v and omega behind their commands, without dead time [s].
    limits
        Range and slew of the command.
    """

    sample_time: float
    time_constant: FloatArray
    limits: Limits


class Law(Protocol):
    """Tracking law: map from its input to the desired twist of the body.

    It is constructed from its gains and a `Delayed`; its attribute `gains` is the type of the gains.
    """

    def start(self, reference: Reference) -> None:
        """Start to track `reference`."""
        ...

    def decide(self, sight: LawInput) -> FloatArray:
        """Compute the desired v [m/s] and omega [rad/s] (2,) of the body."""
        ...


class TrackingPeer:
    """Peer with a tracking law: estimate, predict over the delay, apply the law, limit the command.

    The feed-forward of the predictive controller converts the desired twist into a command: it inverts the model's gain
    and the estimated slip. See `models.interface`.

    Parameters
    ----------
    law
        Tracking law.
    lead
        Prediction time of the state that the law acts on [s].
    side_slip
        True to compensate the estimated side-slip: the robot then turns into the curve, so that it travels along the
        path.
    config
        Limits, estimator and velocity model; by default the shipped configuration of SM, the model with separate dead
        time and lag.
    """

    def __init__(
        self, law: Law, lead: float, *, side_slip: bool = False, config: ControllerConfig | None = None
    ) -> None:
        self._law, self._lead, self._side_slip = law, lead, side_slip
        self._config = config or load_config(MODEL)
        self._estimator = HeldEstimator(self._config)
        model = self._estimator.model
        self._predictor = DelayPredictor(model, self._config.sample_time, lead)
        self._feed_forward, self._aim = formula("feed_forward"), formula("aim")
        self._inverse_gain, self._lag = np.linalg.inv(model.dc_gain), np.maximum(model.lag, 0.0)
        self._last = np.zeros(2)
        self._reference: Reference | None = None

    def start(self, reference: Reference, t0: float) -> None:
        """Start to track `reference`, whose time 0 is `t0` [s]; raise ValueError if it is beyond the limits."""
        self._estimator.start(reference, t0)
        self._law.start(reference)
        self._reference, self._t0 = reference, t0

    def step(self, t: float, measurement: Measurement) -> PeerStep:
        """Compute the command for the tick at `t` [s]; brake without a recent pose.

        Raises RuntimeError if `start` was not called.
        """
        began = time.perf_counter()
        if self._reference is None:
            raise RuntimeError("call start(reference, t0) before step")
        estimate = self._estimator.step(t, measurement)
        since_start = self._since_start(t, estimate)
        wish, mode, message, took = np.zeros(2), "TRACKING", "", 0.0
        failure = self._config.failure
        if estimate is None or not estimate.pose_age <= max(failure.max_pose_age, failure.dead_reckoning):
            mode, message = "BRAKING", "no recent pose"
        elif since_start >= self._reference.duration:
            mode = "FINISHED"
        else:
            slip = estimate.slip
            motion = self._predictor.predict(estimate.pose, estimate.state, slip)
            sight = self._sight(self._reference, since_start, motion, slip if self._side_slip else Slip())
            thinking = time.perf_counter()
            twist, message = self._allowed(self._law.decide(sight), sight)
            took = time.perf_counter() - thinking
            mode = "BRAKING" if message else mode
            wish = np.array(self._feed_forward(twist, slip.flat, self._inverse_gain)).ravel()
        command = nearest_command(wish, self._config.limits, self._config.sample_time, self._last)
        self._estimator.sent(command)
        self._predictor.sent(command)
        self._last = command
        return PeerStep(command, mode, message, time.perf_counter() - began, took)

    def _since_start(self, t: float, estimate: Estimate | None) -> float:
        """Return the time since the start of the reference at `t` [s]; a subclass may use the estimate."""
        del estimate
        return t - self._t0

    def _allowed(self, twist: FloatArray, sight: LawInput) -> tuple[FloatArray, str]:
        """Limit the desired twist (2,) of the law; return it and the reason for a limit, or an empty text."""
        del sight
        return twist, ""

    def _sight(self, reference: Reference, since_start: float, motion: PredictedMotion, slip: Slip) -> LawInput:
        dt = self._config.sample_time
        sample = reference.sample(since_start + np.array([self._lead, *self._lag, self._lag[0] + dt]))
        feed_forward = sample.twist[[1, 2], [0, 1]]
        acceleration = (sample.twist[3, 0] - feed_forward[0]) / dt
        # A turn on the spot has no direction of travel.
        crab = float(self._aim(np.zeros(3), feed_forward, slip.flat, acceleration)[3])
        crab = crab if abs(feed_forward[0]) > STANDING else 0.0
        travel = motion.pose - np.array([0.0, 0.0, crab])
        pose = sample.pose[0].copy()
        pose[2] = travel[2] + float(wrap_angle(pose[2] - travel[2]))
        return LawInput(since_start + self._lead, PredictedMotion(travel, motion.twist), pose, feed_forward)


def make_tracking_peer(
    name: str,
    gains: Gains | None = None,
    config: ControllerConfig | None = None,
    overrides: Mapping[str, object] | None = None,
) -> TrackingPeer:
    """Create the peer of a tracking law, with the shipped gains and configuration by default.

    "NAME+slip" is the law NAME with compensation of side-slip and separate gains. `overrides` replace values of the
    shipped configuration.
    """
    kind = law_kind(name)
    config = config or load_config(MODEL, dict(overrides or {}))
    gains = gains or load_gains(name)
    robot = law_data(config)
    return TrackingPeer(kind(gains, robot), gains.lead, side_slip=name.endswith("+slip"), config=config)


def law_data(config: ControllerConfig) -> Delayed:
    """Return the parameters of the configuration's robot for a law."""
    model = load_linear_model(config.model)
    return Delayed(config.sample_time, model.lag - model.dead_time, config.limits)


def law_kind(name: str) -> Any:  # noqa: ANN401 - the type of the gains depends on the law
    """Return the class of the law of a peer; raise ConfigError for a peer without a law."""
    return _law(name).kind


def load_gains(name: str, path: Path | None = None) -> Gains:
    """Read the gains of a peer from a file of gains by peer, by default the shipped one.

    Raises ConfigError if the file is invalid.
    """
    law = _law(name)
    file = path or law.gains
    gains: Gains = check(law.kind.gains, _read(file)[name], f"{file.name}: {name}")
    return gains


def _law(name: str) -> TrackingLaw:
    peer = find_peer(name)
    if not isinstance(peer, TrackingLaw):
        raise ConfigError(f"the peer '{name}' has no tracking law with gains")
    return peer


@cache
def _read(path: Path) -> Any:  # noqa: ANN401 - checked where it is used
    return read_yaml(path)
