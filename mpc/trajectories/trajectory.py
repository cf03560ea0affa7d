"""What every reference trajectory has: a name, a duration and a way to sample it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from diffdrive_mpc.models.interface import FloatArray, ReferenceSample


@dataclass(frozen=True, eq=False)
class Trajectory(ABC):
    """A timed reference; satisfies `models.interface.Reference`.

    Attributes
    ----------
    name
        Name for tables and figures.
    duration
        Time from start to end [s].
    """

    name: str
    duration: float

    @abstractmethod
    def sample(self, times: ArrayLike) -> ReferenceSample:
        """Evaluate at `times` (n,) [s], counted from the start of the trajectory.

        Before 0 the trajectory rests at its start pose, after `duration` at its end pose, with zero twist. A time
        that is NaN gives a NaN pose.

        Returns
        -------
        ReferenceSample
            pose (n, 3) [m, m, rad unwrapped], twist (n, 2) [m/s, rad/s], arc length (n,) [m].
        """

    def drawn_distance(self, times: ArrayLike) -> FloatArray:
        """Distance (n,) [m] at `times` (n,) [s] from the path as it was drawn: zero unless smooth timing changed it."""
        return np.zeros(np.size(times))
