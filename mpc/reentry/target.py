"""What the planner is given to track."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from diffdrive_mpc.models.interface import FloatArray, Reference, ReferenceSample


class Target(NamedTuple):
    """What to track now.

    Attributes
    ----------
    reference, time
        A reference and the time at which it stands now [s].
    message
        In words, what is out of the ordinary; empty when the robot is on its path and on time.
    blocked_for
        How long the robot has not moved although it is asked to [s]; 0 when it does.
    sample
        The reference from `time` on at the times that were asked for; None where it was not sampled.
    """

    reference: Reference
    time: float
    message: str = ""
    blocked_for: float = 0.0
    sample: ReferenceSample | None = None


@dataclass(frozen=True, eq=False)
class Standing:
    """Satisfies `models.interface.Reference`: standing at `pose` (3,), for a robot that has no way back to its path."""

    pose: FloatArray
    name: str = "standing"
    duration: float = 0.0

    def sample(self, times: ArrayLike) -> ReferenceSample:
        """The same at all `times` (n,) [s]."""
        count = np.asarray(times, dtype=float).size
        return ReferenceSample(np.tile(self.pose, (count, 1)), np.zeros((count, 2)), np.zeros(count))


@dataclass(frozen=True)
class TooFar:
    """The robot is further from its path than allowed: `distance` [m]."""

    distance: float
