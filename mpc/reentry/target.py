"""Target of the current tick, and detection of a blocked robot."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from diffdrive_mpc.models.interface import FloatArray, Reference, ReferenceSample
from diffdrive_mpc.models.pose import wrap_angle


class Target(NamedTuple):
    """Reference to track from the current tick on.

    Attributes
    ----------
    reference, time
        Reference, and its current time [s].
    message
        Message about a deviation; empty while the robot is on its path and on time.
    blocked_for
        Time for which the robot has not moved despite motion commands [s]; 0 while it moves.
    sample
        Samples of the reference at the requested times after `time`; None if the reference was not sampled.
    """

    reference: Reference
    time: float
    message: str = ""
    blocked_for: float = 0.0
    sample: ReferenceSample | None = None


@dataclass(frozen=True, eq=False)
class StandingReference:
    """Constant reference at `pose` (3,) for a robot without a free path back; see `models.interface.Reference`."""

    pose: FloatArray
    name: str = "standing"
    duration: float = 0.0

    def sample(self, times: ArrayLike) -> ReferenceSample:
        """Sample the reference at `times` (n,) [s]."""
        count = np.asarray(times, dtype=float).size
        return ReferenceSample(np.tile(self.pose, (count, 1)), np.zeros((count, 2)), np.zeros(count))


@dataclass(frozen=True)
class TooFar:
    """Result if the `distance` of the robot from its path [m] exceeds the limit."""

    distance: float


# Maximum displacement of a robot at standstill, due to pose noise: position [m], heading [rad].
_POSE_NOISE = (0.04, 0.1)


class BlockedWatch:
    """Detector of a robot that does not move while the reference waits for it.

    Parameters
    ----------
    min_duration
        Minimum duration of standstill of a blocked robot [s].
    """

    def __init__(self, min_duration: float) -> None:
        self._min_duration = min_duration
        self.restart()

    def restart(self) -> None:
        """Restart the measurement of the standstill at the next pose."""
        self._since: float | None = None
        self._pose: FloatArray | None = None

    def update(self, t: float, pose: FloatArray) -> float:
        """Return the duration of standstill at `pose` (3,) and time `t` [s]; 0 if the robot is not blocked."""
        if self._since is None or self._pose is None or self._has_moved(pose):
            self._since, self._pose = t, pose
        standstill = t - self._since
        return standstill if standstill >= self._min_duration else 0.0

    def _has_moved(self, pose: FloatArray) -> bool:
        assert self._pose is not None
        distance = math.hypot(pose[0] - self._pose[0], pose[1] - self._pose[1])
        return distance > _POSE_NOISE[0] or abs(float(wrap_angle(pose[2] - self._pose[2]))) > _POSE_NOISE[1]
