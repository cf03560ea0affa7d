"""Which poses may be believed: stamps, numbers, and jumps, which only repetition makes believable."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from diffdrive_mpc.models.interface import FloatArray, Stamped
from diffdrive_mpc.models.pose import wrap_angle
from diffdrive_mpc.mpc.config.schema import Estimator
from diffdrive_mpc.mpc.measurement_check import covariance, numbers, stamp_fault

# So many poses in a row that contradict the estimate but agree with each other are no outliers.
_AGREEING = 3


@dataclass(frozen=True)
class CheckedPose:
    """A pose of finite numbers with a believable stamp: value (3,), covariance (3, 3), stamp [s]."""

    value: FloatArray
    covariance: FloatArray
    stamp: float


class PoseGate:
    """Checks poses and remembers those that jumped."""

    def __init__(self, settings: Estimator) -> None:
        self._settings = settings
        self._covariance = np.diag(
            np.square([settings.position_noise, settings.position_noise, settings.heading_noise])
        )
        self.reset()

    def reset(self) -> None:
        """Forget every pose."""
        self.accepted_stamp = -np.inf
        self._last_stamp = -np.inf
        self._jumped: list[CheckedPose] = []

    def check(self, t: float, pose: Stamped | None, rejected: list[str]) -> CheckedPose | None:
        """The pose in checked form; None, and a sentence in `rejected`, if it cannot be used."""
        if pose is None:
            return None
        value = numbers(pose.value, 3)
        matrix = self._covariance if pose.covariance is None else covariance(pose.covariance, 3)
        fault = stamp_fault(pose.time, t, self._last_stamp, self._settings.history)
        if value is None:
            fault = "it is not three finite numbers"
        elif matrix is None:
            fault = "its covariance is not a possible 3 x 3 matrix"
        if fault or value is None or matrix is None:
            rejected.append(f"pose rejected: {fault}")
            return None
        self._last_stamp = float(pose.time)
        return CheckedPose(value, matrix, float(pose.time))

    def passes(self, pose: CheckedPose, expected: FloatArray, rejected: list[str]) -> bool:
        """Whether `pose` lies near the `expected` one (3,); if not it is remembered, and named in `rejected`."""
        if not self._differs(pose.value, expected):
            self.accept(pose)
            return True
        if self._jumped and self._differs(pose.value, self._jumped[-1].value):
            self._jumped = []
        self._jumped = [*self._jumped, pose][-_AGREEING:]
        distance = float(np.hypot(*(pose.value - expected)[:2]))
        turn = abs(float(wrap_angle(pose.value[2] - expected[2])))
        rejected.append(f"pose rejected: it jumps by {distance:.2f} m and {turn:.2f} rad")
        return False

    def accept(self, pose: CheckedPose) -> None:
        """Count `pose` as believed, which clears the memory of jumps."""
        self.accepted_stamp = pose.stamp
        self._jumped = []

    @property
    def elsewhere(self) -> CheckedPose | None:
        """The newest of several poses that agree with each other but not with the estimate: the robot was moved."""
        return self._jumped[-1] if len(self._jumped) >= _AGREEING else None

    def _differs(self, value: FloatArray, expected: FloatArray) -> bool:
        distance = np.hypot(*(value - expected)[:2])
        near = distance <= self._settings.max_position_jump
        # Not the other way round: NaN must count as different.
        return not (near and abs(wrap_angle(value[2] - expected[2])) <= self._settings.max_heading_jump)
