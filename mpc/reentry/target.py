"""Target that the planner tracks."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from diffdrive_mpc.models.interface import FloatArray, Reference, ReferenceSample
from diffdrive_mpc.models.pose import wrap_angle


class Target(NamedTuple):
    """Target of the current tick.

    Attributes
    ----------
    reference, time
        A reference and its present time [s].
    message
        Unusual events, in words; empty when the robot is on its path and on time.
    blocked_for
        Time for which the robot has not moved although it is commanded to [s]; 0 when it moves.
    sample
        The reference from `time` on at the requested times; None where it was not sampled.
    """

    reference: Reference
    time: float
    message: str = ""
    blocked_for: float = 0.0
    sample: ReferenceSample | None = None


@dataclass(frozen=True, eq=False)
class StandingReference:
    """Satisfies `models.interface.Reference`: standing at `pose` (3,), for a robot that has no way back to its path."""

    pose: FloatArray
    name: str = "standing"
    duration: float = 0.0

    def sample(self, times: ArrayLike) -> ReferenceSample:
        """Sample the target at all `times` (n,) [s]."""
        count = np.asarray(times, dtype=float).size
        return ReferenceSample(np.tile(self.pose, (count, 1)), np.zeros((count, 2)), np.zeros(count))


@dataclass(frozen=True)
class TooFar:
    """The robot is further from its path than allowed: `distance` [m]."""

    distance: float


# Whether the robot moves at all while the reference waits for it.


# Displacements below this are noise of the pose: m, rad.
_STIR = (0.04, 0.1)


class BlockedWatch:
    """Detector of a robot that has stayed in place for too long.

    Parameters
    ----------
    after
        Time without motion after which it counts as blocked [s].
    """

    def __init__(self, after: float) -> None:
        self._after = after
        self.restart()

    def restart(self) -> None:
        """Restart with the next pose."""
        self._since: float | None = None
        self._pose: FloatArray | None = None

    def look(self, t: float, pose: FloatArray) -> float:
        """Return for how long [s] the robot has been blocked at `pose` (3,), now `t` [s]; 0 if it is not."""
        if self._since is None or self._pose is None or self._moved(pose):
            self._since, self._pose = t, pose
        still = t - self._since
        return still if still >= self._after else 0.0

    def _moved(self, pose: FloatArray) -> bool:
        assert self._pose is not None
        away = math.hypot(pose[0] - self._pose[0], pose[1] - self._pose[1])
        return away > _STIR[0] or abs(float(wrap_angle(pose[2] - self._pose[2]))) > _STIR[1]
