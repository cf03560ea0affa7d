"""A reference that is rejoined: a connection from the robot, then the reference itself, on the reference's clock."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from diffdrive_mpc.models.interface import Reference, ReferenceSample
from diffdrive_mpc.mpc.trajectories.trajectory import Trajectory


@dataclass(frozen=True, eq=False)
class Rejoin:
    """Satisfies `models.interface.Reference`.

    Attributes
    ----------
    connection
        The motion from the robot to the reference.
    reference
        What is rejoined.
    joins
        Reference time at which the connection ends [s].
    ahead
        Length of the connection [m].
    """

    connection: Trajectory
    reference: Reference
    joins: float
    ahead: float

    @property
    def name(self) -> str:
        """Name of the reference."""
        return self.reference.name

    @property
    def duration(self) -> float:
        """Time at which the reference ends [s]."""
        return self.reference.duration

    @property
    def begins(self) -> float:
        """Reference time at which the connection begins [s]; may be negative."""
        return self.joins - self.connection.duration

    def sample(self, times: ArrayLike) -> ReferenceSample:
        """Evaluate at `times` (n,) [s] on the reference's clock: the connection before `joins`, then the reference."""
        times = np.atleast_1d(np.asarray(times, dtype=float))
        after = self.reference.sample(times)
        before = times < self.joins
        if not before.any():
            return after
        part = self.connection.sample(times - self.begins)
        start = float(self.reference.sample([self.joins]).arc_length[0]) - self.ahead
        return ReferenceSample(
            np.where(before[:, None], part.pose, after.pose),
            np.where(before[:, None], part.twist, after.twist),
            np.where(before, start + part.arc_length, after.arc_length),
        )
