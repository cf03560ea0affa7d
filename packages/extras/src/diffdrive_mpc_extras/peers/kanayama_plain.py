"""Tracking law of Kanayama et al. with the last measured pose, without state estimation or prediction."""

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
    """Load gains for `KanayamaController`, by default the shipped gains; raise ConfigError if the file is invalid."""
    return load_checked(KanayamaGains, path or Path(__file__).parent / "kanayama_plain.yaml")


class KanayamaController:
    """Feed-forward of the reference twist and feedback of the last measured pose.

    The error is computed at the stamp of the pose, so a delayed pose does not appear as a tracking error.

    Parameters
    ----------
    gains
        Gains of the law, by default the shipped gains.
    robot
        Robot with command and slew limits, by default the robot of the papers.
    """

    def __init__(self, gains: KanayamaGains | None = None, robot: Robot | None = None) -> None:
        self._gains = gains or load_plain_gains()
        self._robot = robot or load_robot()
        self._reference: Reference | None = None

    def start(self, reference: Reference, t0: float) -> None:
        """Start tracking `reference`, whose time 0 is `t0` [s]."""
        self._reference, self._t0 = reference, t0
        self._error, self._last_command, self._last_time = np.zeros(3), np.zeros(2), None

    _last_time: float | None

    def step(self, t: float, measurement: Measurement) -> PeerStep:
        """Return the command for the tick at time `t` [s]; if there is no finite pose, use the last error.

        Raises RuntimeError if `start` was not called.
        """
        start = time.perf_counter()
        if self._reference is None:
            raise RuntimeError("call start(reference, t0) before step")
        message = self._update_error(self._reference, measurement)
        finished = t - self._t0 >= self._reference.duration
        feed_forward = self._reference.sample([t - self._t0]).twist[0]
        desired = np.zeros(2) if finished else kanayama_twist(self._gains, feed_forward, self._error)
        command = self._limit(desired, t)
        mode = "FINISHED" if finished else "TRACKING"
        return PeerStep(command, mode, message, time.perf_counter() - start)

    def _update_error(self, reference: Reference, measurement: Measurement) -> str:
        """Update the error in the robot's frame: ahead [m], to the left [m], heading [rad]; return a message."""
        if measurement.pose is None:
            return ""
        pose = np.asarray(measurement.pose.value, dtype=float)
        if not np.isfinite(pose).all():
            return "the pose is not finite; using the last error"
        gap = reference.sample([measurement.pose.time - self._t0]).pose[0] - pose
        self._error = np.array([*ahead_and_left(gap, pose[2]), float(wrap_angle(gap[2]))])
        return ""

    def _limit(self, desired: FloatArray, t: float) -> FloatArray:
        """Return the nearest command (2,) within command limits and slew limits."""
        dt = self._robot.sample_time if self._last_time is None else max(0.0, t - self._last_time)
        limit = np.array([self._robot.limits.v, self._robot.limits.omega])
        max_change = dt * np.array([self._robot.command_slew.v, self._robot.command_slew.omega])
        desired = np.clip(desired, -limit, limit)
        command = np.clip(desired, self._last_command - max_change, self._last_command + max_change)
        self._last_command, self._last_time = command, t
        return command
