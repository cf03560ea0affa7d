"""The tracking law of Kanayama et al. on the last measured pose, without estimate and prediction."""

from __future__ import annotations

import time
from functools import cache
from pathlib import Path

import numpy as np

from diffdrive_mpc.bench.peers import PeerStep
from diffdrive_mpc.bench.peers.kanayama import KanayamaGains, kanayama_twist
from diffdrive_mpc.models.checked_yaml import load_checked
from diffdrive_mpc.models.interface import FloatArray, Measurement, Reference
from diffdrive_mpc.models.pose import ahead_and_left, wrap_angle
from diffdrive_mpc.models.robot import Robot, load_robot


@cache
def load_plain_gains(path: Path | None = None) -> KanayamaGains:
    """Read a file of gains for `KanayamaController`, by default the shipped one; raises ConfigError on a mistake."""
    return load_checked(KanayamaGains, path or Path(__file__).parent / "kanayama_plain.yaml")


class KanayamaController:
    """Feedback of the last measured pose on top of the reference's twist: the law without estimate and prediction.

    The error is taken at the instant the pose describes, so that a late pose does not look like a robot that lags.

    Parameters
    ----------
    gains
        Gains of the law; by default the shipped ones.
    robot
        Robot whose command and slew limits hold; by default the robot of the papers.
    """

    def __init__(self, gains: KanayamaGains | None = None, robot: Robot | None = None) -> None:
        self._gains = gains or load_plain_gains()
        self._robot = robot or load_robot()
        self._reference: Reference | None = None

    def start(self, reference: Reference, t0: float) -> None:
        """Start to track `reference`, whose time 0 is `t0` [s]."""
        self._reference, self._t0 = reference, t0
        self._error, self._last_command, self._last_time = np.zeros(3), np.zeros(2), None

    _last_time: float | None

    def step(self, t: float, measurement: Measurement) -> PeerStep:
        """Decide the command for the tick at time `t` [s]; without a usable pose the last error is kept.

        Raises RuntimeError if `start` was not called.
        """
        began = time.perf_counter()
        if self._reference is None:
            raise RuntimeError("call start(reference, t0) before step")
        message = self._take_error(self._reference, measurement)
        finished = t - self._t0 >= self._reference.duration
        feed_forward = self._reference.sample([t - self._t0]).twist[0]
        wish = np.zeros(2) if finished else kanayama_twist(self._gains, feed_forward, self._error)
        command = self._limited(wish, t)
        mode = "FINISHED" if finished else "TRACKING"
        return PeerStep(command, mode, message, time.perf_counter() - began)

    def _take_error(self, reference: Reference, measurement: Measurement) -> str:
        """Compute the error in the robot's frame at the pose's stamp: ahead [m], to the left [m], turned left [rad]."""
        if measurement.pose is None:
            return ""
        pose = np.asarray(measurement.pose.value, dtype=float)
        if not np.isfinite(pose).all():
            return "the pose is not finite; the last error is kept"
        gap = reference.sample([measurement.pose.time - self._t0]).pose[0] - pose
        self._error = np.array([*ahead_and_left(gap, pose[2]), float(wrap_angle(gap[2]))])
        return ""

    def _limited(self, wish: FloatArray, t: float) -> FloatArray:
        """Return the nearest command inside the robot's limits and within reach of the last one."""
        dt = self._robot.sample_time if self._last_time is None else max(0.0, t - self._last_time)
        bound = np.array([self._robot.limits.v, self._robot.limits.omega])
        reach = dt * np.array([self._robot.command_slew.v, self._robot.command_slew.omega])
        wish = np.clip(wish, -bound, bound)
        command = np.clip(wish, self._last_command - reach, self._last_command + reach)
        self._last_command, self._last_time = command, t
        return command
