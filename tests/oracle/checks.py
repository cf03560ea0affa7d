"""Checks of measurements: stamps, values, ranges, single outliers, and jumps of the pose."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from diffdrive_mpc.models.interface import FloatArray, Measurement, Stamped
from diffdrive_mpc.mpc.config.schema import Estimator, PoseResponse, SensorResponses, SpeedResponse
from oracle.motion import wrap

_MAX_VARIANCE = 1e6
_ASYMMETRY = 1e-6
_FUTURE = 1e-3
# Number of successive rejected poses that count as valid if they agree with each other.
_AGREEING = 3


def numbers(value: Any, count: int) -> FloatArray | None:
    """Return `value` as an array of `count` finite numbers, or None if that is impossible."""
    try:
        array = np.asarray(value, dtype=float).ravel()
    except (TypeError, ValueError, OverflowError):
        return None
    return array if len(array) == count and bool(np.isfinite(array).all()) else None


def covariance(value: Any, size: int) -> FloatArray | None:
    """Return `value` as a symmetric positive definite matrix (size, size) with plausible entries, or None."""
    entries = numbers(value, size * size)
    if entries is None or np.abs(entries).max() > _MAX_VARIANCE:
        return None
    matrix = entries.reshape(size, size)
    if (np.abs(matrix - matrix.T) > _ASYMMETRY * np.abs(matrix)).any():
        return None
    try:
        np.linalg.cholesky(matrix)
    except np.linalg.LinAlgError:
        return None
    return matrix


def stamp_fault(stamp: object, t: float, last: float, history: float, delay: float) -> str:
    """Return the fault of a stamp at tick `t` [s], or "".

    `last` [s] is the previous stamp; the reading is `delay` [s] older than its stamp.
    """
    time = numbers(stamp, 1)
    if time is None:
        return "its stamp is not a finite number"
    age = t - float(time[0])
    if age < -_FUTURE:
        return f"its stamp lies {-age:.3f} s in the future"
    if time[0] <= last:
        return "its stamp is not newer than the previous one"
    age += delay
    return f"it is {age:.2f} s old; the history reaches back {history} s" if age > history else ""


def sent_command(sent: object, largest: FloatArray) -> FloatArray | None:
    """Return the command (2,) that the robot reports, or None if it is invalid."""
    value = numbers(sent, 2)
    if value is None or (np.abs(value) > largest).any():
        return None
    return value


@dataclass(frozen=True)
class CheckedPose:
    """Finite pose with a plausible stamp: value (3,), covariance (3, 3), stamp and time of validity `true_at` [s]."""

    value: FloatArray
    covariance: FloatArray
    stamp: float
    true_at: float


class PoseRate:
    """Detector of rare poses, from the number of late poses among the last five."""

    def __init__(self, dt: float, max_pose_age: float, history: float) -> None:
        self.dt, self.max_pose_age, self.history = dt, max_pose_age, history
        # Initially, one overdue pose is enough.
        self.overdue = [True]
        self.interval = self.latency = self.too_old = 0.0
        self.rare = False

    def accept(self, stamp: float, last_stamp: float, now: float) -> None:
        """Record an accepted pose that arrived at the tick `now` [s]."""
        self.too_old = 0.0
        if not math.isfinite(last_stamp):
            return
        interval, latency = stamp - last_stamp, now - stamp
        overdue = interval + latency - self.dt > self.max_pose_age
        if overdue:
            self.interval, self.latency = interval, latency
            self.rare = self.rare or any(self.overdue)
        self.overdue = [overdue, *self.overdue][:5]
        self.rare = self.rare and any(self.overdue)

    @property
    def usual_age(self) -> float:
        """Usual maximum age of rare poses [s]."""
        return self.interval + self.latency if self.rare else 0.0

    def words(self) -> list[str]:
        """Return a message if poses are too rare."""
        if not self.rare:
            return []
        latency = self.too_old or self.latency
        return [
            f"poses come every {self.interval:.2f} s and {latency:.2f} s late, too rarely for failure.max_pose_age of "
            f"{self.max_pose_age:g} s: the robot stays braked; raise it above {self.interval + latency:.2f} s, or "
            "send poses more often or sooner"
        ]

    def missing(self) -> list[str]:
        """Return a message if poses arrive but are too old for the history."""
        if not self.too_old:
            return []
        return [
            f"poses come {self.too_old:.2f} s late, and the history reaches back {self.history:g} s: raise "
            "estimator.history, or send poses sooner"
        ]


class PoseGate:
    """Gate that checks poses and stores the poses that jump."""

    def __init__(self, settings: Estimator, rate: PoseRate, known: PoseResponse) -> None:
        self.settings, self.rate, self.now = settings, rate, math.nan
        self.delay, self.heading = known.delay, known.heading
        self.last_stamp = self.accepted_stamp = -np.inf
        self.jumped: list[CheckedPose] = []

    def check(self, t: float, pose: Stamped | None, rejected: list[str]) -> CheckedPose | None:
        """Return the checked pose; for an unusable pose, return None and add a sentence to `rejected`."""
        if pose is None:
            return None
        s = self.settings
        assumed = np.diag([s.position_noise**2, s.position_noise**2, s.heading_noise**2])
        value, matrix = numbers(pose.value, 3), assumed if pose.covariance is None else covariance(pose.covariance, 3)
        fault = stamp_fault(pose.time, t, self.last_stamp, s.history, self.delay)
        if value is None:
            fault = "it is not three finite numbers"
        elif matrix is None:
            fault = "its covariance is not a valid 3 x 3 matrix"
        if fault:
            rejected.append(f"pose rejected: {fault}")
            if "the history reaches back" in fault:
                self.rate.too_old = t - float(pose.time) + self.delay
            return None
        self.last_stamp = float(pose.time)
        value = value - [0.0, 0.0, self.heading]
        return CheckedPose(value, matrix, self.last_stamp, self.last_stamp - self.delay)

    def passes(self, pose: CheckedPose, expected: FloatArray, rejected: list[str]) -> bool:
        """Return True if `pose` is near `expected` (3,); otherwise store it and add a sentence to `rejected`."""
        if self._near(pose.value, expected):
            self.accept(pose)
            return True
        if self.jumped and not self._near(pose.value, self.jumped[-1].value):
            self.jumped = []
        self.jumped.append(pose)
        distance, turn = _difference(pose.value, expected)
        rejected.append(f"pose rejected: it jumps by {distance:.2f} m and {turn:.2f} rad")
        return False

    def accept(self, pose: CheckedPose) -> None:
        """Accept `pose`, which clears the stored jumps."""
        self.rate.accept(pose.stamp, self.accepted_stamp, self.now)
        self.accepted_stamp, self.jumped = pose.stamp, []

    @property
    def elsewhere(self) -> CheckedPose | None:
        """Latest of several poses that agree with each other but not with the estimate: the robot was moved."""
        return self.jumped[-1] if len(self.jumped) >= _AGREEING else None

    def _near(self, value: FloatArray, expected: FloatArray) -> bool:
        distance, turn = _difference(value, expected)
        return distance <= self.settings.max_position_jump and turn <= self.settings.max_heading_jump


def _difference(first: FloatArray, second: FloatArray) -> tuple[float, float]:
    return float(np.hypot(*(first - second)[:2])), abs(float(wrap(first[2] - second[2])))


@dataclass(frozen=True)
class CheckedTwist:
    """One component of a measured twist, valid at `stamp` [s], with the name of its message."""

    message: str
    sensor: str
    value: float
    variance: float
    stamp: float


class TwistGate:
    """Gate for a message with one value for each of `sensors`: maximum values, and jumps from the last message."""

    def __init__(
        self, message: str, sensors: dict[str, tuple[float, float, float]], history: float, known: SpeedResponse
    ) -> None:
        self.message, self.sensors, self.history, self.known = message, tuple(sensors), history, known
        self.delay = known.delay + known.lag
        noise, self.largest, self.jump = np.array(list(sensors.values())).T
        self.variances = noise**2
        self.stamp, self.last = -np.inf, np.zeros(len(sensors))

    def check(self, t: float, stamped: Stamped | None, rejected: list[str]) -> list[CheckedTwist]:
        """Return the usable reading; add a sentence to `rejected` if it cannot be used."""
        if stamped is None:
            return []
        size, last = len(self.sensors), self.last
        values, variances = numbers(stamped.value, size), self.variances
        values = None if values is None else values / self.known.scale
        fault = stamp_fault(stamped.time, t, self.stamp, self.history, self.delay)
        if values is None:
            fault = "not finite" if size == 1 else f"not {size} finite numbers"
        elif (np.abs(values) > self.largest).any():
            index = int(np.argmax(np.abs(values) > self.largest))
            fault = f"{values[index]:.3g} is more than {self.largest[index]:g}"
        elif stamped.covariance is not None:
            matrix = covariance(stamped.covariance, size)
            if matrix is None:
                fault = "its covariance is not a valid covariance"
            else:
                variances = np.diag(matrix) / self.known.scale**2
        if not fault:
            self.stamp, self.last = float(stamped.time), values
            # The speed of a wheel jumps if the robot hits a wall; the next sample then confirms the value.
            jumps = np.abs(values - last) > self.jump
            if jumps.any():
                index = int(np.argmax(jumps))
                fault = f"it jumps from {last[index]:.2f} to {values[index]:.2f}"
        if fault:
            rejected.append(f"{self.message} rejected: {fault}")
            return []
        return [
            CheckedTwist(self.message, *part, self.stamp - self.delay)
            for part in zip(self.sensors, values.tolist(), variances.tolist(), strict=True)
        ]


class TwistGates:
    """Gates for encoders and gyro."""

    def __init__(self, settings: Estimator, known: SensorResponses) -> None:
        s = settings
        wheels = {
            "wheel_speed": (s.wheel_speed_noise, s.max_wheel_speed, s.max_wheel_speed_jump),
            "wheel_yaw_rate": (s.wheel_yaw_rate_noise, s.max_yaw_rate, s.max_yaw_rate_jump),
        }
        gyro = {"yaw_rate": (s.yaw_rate_noise, s.max_yaw_rate, s.max_yaw_rate_jump)}
        self.wheels = TwistGate("wheel speed", wheels, s.history, known.wheels)
        self.gyro = TwistGate("yaw rate", gyro, s.history, known.yaw_rate)

    def check(self, t: float, measurement: Measurement, rejected: list[str]) -> list[CheckedTwist]:
        """Return usable readings; add a sentence to `rejected` for each message that cannot be used."""
        wheels = self.wheels.check(t, measurement.wheel_twist, rejected)
        return wheels + self.gyro.check(t, measurement.yaw_rate, rejected)
