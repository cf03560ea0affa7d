"""A reference by its arc length: poses at even distances, and where it stands and turns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from diffdrive_mpc.models.interface import FloatArray, Reference
from diffdrive_mpc.mpc.config.fixed_values import STANDING, TURNING

SPACING = 0.05
"""Between two nodes [m]; wider for a reference of more than `MOST` nodes."""
MOST = 100_000
_MOST_SAMPLES = 100_000
# Nodes nearer than this to a turn on the spot or a cusp are not moved aside [m].
_STAYS = 0.1


@dataclass(frozen=True, eq=False)
class PathTable:
    """The nodes of a path.

    Attributes
    ----------
    spacing
        Between two of them [m].
    pose
        (m, 3), theta unwrapped.
    travel
        (m,) 1 where it drives forwards, -1 backwards.
    curvature
        (m,) of the heading by distance [rad/m].
    speed
        (m,) of the reference [m/s].
    fixed
        (m,) whether a node must not be moved aside: the end, and where it turns on the spot or changes its direction.
    """

    spacing: float
    pose: FloatArray
    travel: FloatArray
    curvature: FloatArray
    speed: FloatArray
    fixed: FloatArray

    @classmethod
    def of(cls, reference: Reference) -> PathTable:
        """The table of a reference."""
        times = np.linspace(0.0, reference.duration, min(int(reference.duration / 0.02) + 2, _MOST_SAMPLES))
        sample = reference.sample(times)
        arc, v, omega = sample.arc_length, sample.twist[:, 0], sample.twist[:, 1]
        spacing = max(SPACING, float(arc[-1]) / MOST)
        nodes = np.arange(int(arc[-1] / spacing) + 2) * spacing
        pose = np.stack([np.interp(nodes, arc, column) for column in sample.pose.T], axis=1)
        moves = np.abs(v) > STANDING
        direction = np.where(v[moves] < 0.0, -1.0, 1.0) if moves.any() else np.ones(1)
        moving_arc = arc[moves] if moves.any() else np.zeros(1)
        travel = np.sign(np.interp(nodes, moving_arc, direction) + 1e-12)
        curvature = np.interp(nodes, moving_arc, omega[moves] / np.abs(v[moves]) if moves.any() else np.zeros(1))
        speed = np.interp(nodes, moving_arc, np.abs(v[moves]) if moves.any() else np.zeros(1))
        turns = ~moves & (np.abs(omega) > TURNING)
        cusps = np.flatnonzero(np.diff(direction) != 0.0)
        stays = np.concatenate([arc[turns], moving_arc[cusps], arc[-1:]])
        near = np.searchsorted(np.sort(stays), nodes)
        stays = np.concatenate([[-np.inf], np.sort(stays), [np.inf]])
        fixed = np.minimum(nodes - stays[near], stays[near + 1] - nodes) <= _STAYS
        return cls(spacing, pose, travel, curvature, speed, fixed.astype(float))

    def __len__(self) -> int:
        """How many nodes there are."""
        return len(self.pose)
