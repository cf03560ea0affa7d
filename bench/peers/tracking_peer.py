"""Common parts of all peers with a tracking law: estimation, prediction and limits of the command."""

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
from diffdrive_mpc.models.two_sided import limit_step
from diffdrive_mpc.mpc import ControllerConfig, load_config
from diffdrive_mpc.mpc.config.schema import Limits
from diffdrive_mpc.mpc.estimate import Estimate
from diffdrive_mpc.mpc.problem.formulas import formula
from diffdrive_mpc.mpc.problem.slip import Slip

# Limits of a peer's command, which equal those of the predictive controller: range and slew rate.


def slew_step(limits: Limits, dt: float) -> FloatArray:
    """Compute the maximum change (2,) of the command per tick, valid in both directions [m/s, rad/s]."""
    return np.array([limits.v_slew, limits.omega_slew]) * dt


def nearest_command(command: FloatArray, limits: Limits, dt: float, last: FloatArray) -> FloatArray:
    """Return the command (2,) nearest to `command` (2,) within the range and the slew limits from `last` (2,)."""
    upper, lower = np.transpose([limits.v.sides, limits.omega.sides])
    max_rise, max_fall = np.transpose([limits.v_slew.sides, limits.omega_slew.sides]) * dt
    return limit_step(last, np.clip(command, -lower, upper), max_rise, max_fall)


REST_SPEED = 0.01
"""Maximum speed of a reference that counts as at rest or turning on the spot [m/s]."""
MODEL = "sm"
"""Model and built-in configuration of all peers with a tracking law: SM, which separates dead time and lag."""

NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
AboveZero = Annotated[float, Field(gt=0, allow_inf_nan=False)]


class Gains(StrictModel):
    """Tuned parameters of a law: its prediction time and, in subclasses, its gains."""

    lead: NotNegative = Field(0.0, description="prediction time of the pose on which the law acts [s]")


@dataclass(frozen=True, slots=True)
class LawInput:
    """Input of a law at one tick; all values refer to the time at which the command takes effect.

    Attributes
    ----------
    time
        Time since the start of the reference [s].
    motion
        Predicted pose (3,) and twist (2,); with compensation of side-slip, the heading is the direction of travel.
    reference
        Pose (3,) of the reference; its heading differs by at most pi from that of `motion`.
    feed_forward
        Twist (2,) of the reference, each channel sampled one lag later [m/s, rad/s].
    """

    time: float
    motion: PredictedMotion
    reference: FloatArray
    feed_forward: FloatArray

    @property
    def error(self) -> FloatArray:
        """Pose (3,) of the reference in the robot's frame: ahead [m], to the left [m], heading [rad]."""
        gap = self.reference - self.motion.pose
        return np.array([*ahead_and_left(gap, self.motion.pose[2]), gap[2]])


@dataclass(frozen=True)
class RobotParameters:
    """Parameters of the robot that a law may use in addition to the prediction.

    Attributes
    ----------
    sample_time
        Period of the ticks [s].
    time_constant
        Lag (2,) of v and omega behind their commands without dead time [s].
    limits
        Range and slew limits of the command.
    """

    sample_time: float
    time_constant: FloatArray
    limits: Limits


class Law(Protocol):
    """Tracking law, which maps its input to the desired twist of the body.

    A law is constructed from its gains and a `RobotParameters`; the class attribute `gains` is the type of the gains.
    """

    def start(self, reference: Reference) -> None:
        """Start to track `reference`."""
        ...

    def decide(self, law_input: LawInput) -> FloatArray:
        """Compute the desired v [m/s] and omega [rad/s] (2,) of the body."""
        ...


class TrackingPeer:
    """Peer that estimates the state, predicts it over the delay, applies a tracking law and limits the command.

    The desired twist is converted into a command by the feed-forward of the predictive controller, which inverts the
    gain of the model and the estimated slip. See `models.interface`.

    Parameters
    ----------
    law
        Tracking law.
    lead
        Prediction time of the state on which the law acts [s].
    side_slip
        True to compensate the estimated side-slip: the robot then points into the curve, so that its direction of
        travel is tangential to the path.
    config
        Configuration with limits, estimator and velocity model; by default the built-in configuration of `MODEL`.
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
        """Start to track `reference`, whose time 0 is `t0` [s]; raise ValueError if `reference` exceeds the limits."""
        self._estimator.start(reference, t0)
        self._law.start(reference)
        self._reference, self._t0 = reference, t0

    def step(self, t: float, measurement: Measurement) -> PeerStep:
        """Compute the command for the tick at `t` [s]; brake if there is no recent pose.

        Raise RuntimeError if `start` was not called.
        """
        start = time.perf_counter()
        if self._reference is None:
            raise RuntimeError("call start(reference, t0) before step")
        estimate = self._estimator.step(t, measurement)
        reference_time = self._reference_time(t, estimate)
        desired_command, mode, message, law_time = np.zeros(2), "TRACKING", "", 0.0
        failure = self._config.failure
        if estimate is None or not estimate.pose_age <= max(failure.max_pose_age, failure.dead_reckoning):
            mode, message = "BRAKING", "no recent pose"
        elif reference_time >= self._reference.duration:
            mode = "FINISHED"
        else:
            slip = estimate.slip
            motion = self._predictor.predict(estimate.pose, estimate.state, slip)
            law_input = self._law_input(self._reference, reference_time, motion, slip if self._side_slip else Slip())
            law_start = time.perf_counter()
            twist, message = self._limit_twist(self._law.decide(law_input), law_input)
            law_time = time.perf_counter() - law_start
            mode = "BRAKING" if message else mode
            desired_command = np.array(self._feed_forward(twist, slip.flat, self._inverse_gain)).ravel()
        command = nearest_command(desired_command, self._config.limits, self._config.sample_time, self._last)
        self._estimator.record_command(command)
        self._predictor.record_command(command)
        self._last = command
        return PeerStep(command, mode, message, time.perf_counter() - start, law_time)

    def _reference_time(self, t: float, estimate: Estimate | None) -> float:
        """Return the time of the reference at time `t` [s]; subclasses may use the estimate instead of the clock."""
        del estimate
        return t - self._t0

    def _limit_twist(self, twist: FloatArray, law_input: LawInput) -> tuple[FloatArray, str]:
        """Limit the desired twist (2,) of the law; return the limited twist and a reason if the robot must brake."""
        del law_input
        return twist, ""

    def _law_input(self, reference: Reference, reference_time: float, motion: PredictedMotion, slip: Slip) -> LawInput:
        dt = self._config.sample_time
        sample = reference.sample(reference_time + np.array([self._lead, *self._lag, self._lag[0] + dt]))
        feed_forward = sample.twist[[1, 2], [0, 1]]
        acceleration = (sample.twist[3, 0] - feed_forward[0]) / dt
        # A turn on the spot has no direction of travel.
        side_slip_angle = float(self._aim(np.zeros(3), feed_forward, slip.flat, acceleration)[3])
        side_slip_angle = side_slip_angle if abs(feed_forward[0]) > REST_SPEED else 0.0
        travel = motion.pose - np.array([0.0, 0.0, side_slip_angle])
        pose = sample.pose[0].copy()
        pose[2] = travel[2] + float(wrap_angle(pose[2] - travel[2]))
        return LawInput(reference_time + self._lead, PredictedMotion(travel, motion.twist), pose, feed_forward)


def make_tracking_peer(
    name: str,
    gains: Gains | None = None,
    config: ControllerConfig | None = None,
    overrides: Mapping[str, object] | None = None,
) -> TrackingPeer:
    """Create the peer of a tracking law, by default with the built-in gains and configuration.

    "NAME+slip" is the law NAME with compensation of side-slip and with separate gains. `overrides` replace values of
    the built-in configuration.
    """
    kind = law_kind(name)
    config = config or load_config(MODEL, dict(overrides or {}))
    gains = gains or load_gains(name)
    robot = robot_parameters(config)
    return TrackingPeer(kind(gains, robot), gains.lead, side_slip=name.endswith("+slip"), config=config)


def robot_parameters(config: ControllerConfig) -> RobotParameters:
    """Return the parameters of the robot in a configuration that a law may use."""
    model = load_linear_model(config.model)
    return RobotParameters(config.sample_time, model.lag - model.dead_time, config.limits)


def law_kind(name: str) -> Any:  # noqa: ANN401 - the type of the gains depends on the law
    """Return the class of the law of a peer; raise ConfigError if the peer does not have a law."""
    return _law(name).kind


def load_gains(name: str, path: Path | None = None) -> Gains:
    """Read the gains of a peer from a file, by default the file of its law.

    Raise ConfigError if the file is invalid.
    """
    law = _law(name)
    file = path or law.gains
    gains: Gains = check(law.kind.gains, _read(file)[name], f"{file.name}: {name}")
    return gains


def _law(name: str) -> TrackingLaw:
    peer = find_peer(name)
    if not isinstance(peer, TrackingLaw):
        raise ConfigError(f"the peer '{name}' does not have a tracking law with gains")
    return peer


@cache
def _read(path: Path) -> Any:  # noqa: ANN401 - checked where it is used
    return read_yaml(path)
