"""What the planner is given to track."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from diffdrive_mpc.models.interface import Reference, ReferenceSample


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


@dataclass(frozen=True)
class TooFar:
    """The robot is further from its path than allowed: `distance` [m]."""

    distance: float
