"""A trajectory laid somewhere else."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from diffdrive_mpc.models.interface import FloatArray, Reference, ReferenceSample
from diffdrive_mpc.mpc.trajectories.native import NativeTrajectory


@dataclass(frozen=True, eq=False)
class MovedReference:
    """A reference turned about the origin and then moved; satisfies `models.interface.Reference`.

    Attributes
    ----------
    original
        The reference as it was.
    motion
        (3,) x, y [m] by which it is moved after it was turned by theta [rad].
    """

    original: Reference
    motion: FloatArray

    @property
    def name(self) -> str:
        """Name of the original."""
        return self.original.name

    @property
    def duration(self) -> float:
        """Duration of the original [s]."""
        return self.original.duration

    @cached_property
    def native(self) -> NativeTrajectory | None:
        """The same in the compiled core, where that can sample the original."""
        found = getattr(self.original, "native", None)
        if not isinstance(found, NativeTrajectory) or any(found.struct.motion):
            return None
        return found.moved(self.motion)

    def __getstate__(self) -> dict[str, object]:
        """Without the memory of C."""
        return {name: value for name, value in self.__dict__.items() if name != "native"}

    def sample(self, times: ArrayLike) -> ReferenceSample:
        """Evaluate at `times` (n,) [s]; twist and arc length are the original's."""
        found = self.original.sample(times)
        x, y, theta = self.motion
        cos, sin = np.cos(theta), np.sin(theta)
        pose = np.empty_like(found.pose)
        pose[:, 0] = x + cos * found.pose[:, 0] - sin * found.pose[:, 1]
        pose[:, 1] = y + sin * found.pose[:, 0] + cos * found.pose[:, 1]
        pose[:, 2] = theta + found.pose[:, 2]
        return found._replace(pose=pose)


def starting_at(reference: Reference, pose: ArrayLike) -> MovedReference:
    """`reference` turned and moved so that it starts at `pose` (3,) x, y [m], theta [rad]."""
    start = reference.sample([0.0]).pose[0]
    x, y, theta = np.asarray(pose, dtype=float)
    turn = theta - start[2]
    cos, sin = np.cos(turn), np.sin(turn)
    return MovedReference(
        reference,
        np.array([x - cos * start[0] + sin * start[1], y - sin * start[0] - cos * start[1], turn]),
    )
