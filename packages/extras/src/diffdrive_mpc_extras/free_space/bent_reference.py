"""A reference that is moved aside, as far as its guide says."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from diffdrive_mpc.models.interface import FloatArray, Reference, ReferenceSample
from diffdrive_mpc.mpc.config.fixed_values import STANDING
from diffdrive_mpc_extras.free_space.guide import Guide


@dataclass(frozen=True, eq=False)
class BentReference:
    """Satisfies `models.interface.Reference`: `reference` on its own time, moved to the left by the guide's offsets."""

    reference: Reference
    guide: Guide

    @property
    def name(self) -> str:
        """Name of the reference."""
        return self.reference.name

    @property
    def duration(self) -> float:
        """Time from start to end [s]."""
        return self.reference.duration

    def sample(self, times: ArrayLike) -> ReferenceSample:
        """Evaluate at `times` (n,) [s]; arc lengths stay those of the reference.

        With the offset l to the left and the curvature k, along the travel s = 1 or -1: the point moves at
        v sqrt((1 - s l k)^2 + l'^2), in the direction atan2(s l', 1 - s l k) from the heading.
        """
        plain = self.reference.sample(times)
        if not self.guide.bent:
            return plain
        pose, twist, arc = plain
        table = self.guide.table
        offset, slope, bend = _cubic(self.guide.offset, self.guide.slope, table.spacing, arc)
        travel, moves = np.where(twist[:, 0] < 0.0, -1.0, 1.0), np.abs(twist[:, 0]) > STANDING
        node = np.minimum((arc / table.spacing).astype(int), len(table) - 1)
        speed = np.where(moves, np.abs(twist[:, 0]), 1.0)
        travel = np.where(moves, travel, table.travel[node])
        curvature = np.where(moves, twist[:, 1] / speed, table.curvature[node])
        forward = 1.0 - travel * offset * curvature
        turned = np.arctan2(travel * slope, forward)
        stretch = np.hypot(forward, slope)
        turning = travel * (bend * forward + slope**2 * curvature * travel) / stretch**2
        heading = pose[:, 2]
        x, y = pose[:, 0] - np.sin(heading) * offset, pose[:, 1] + np.cos(heading) * offset
        rate = twist[:, 1] + np.where(moves, turning * speed, 0.0)
        moved = np.stack([x, y, heading + turned], axis=1)
        return ReferenceSample(moved, np.stack([twist[:, 0] * stretch, rate], axis=1), arc)


def _cubic(
    values: FloatArray, slopes: FloatArray, spacing: float, at: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Value, slope and second derivative (n,) at `at` of the cubics through `values` with `slopes` every `spacing`."""
    if len(values) < 2:
        return np.full(at.shape, values[0]), np.zeros(at.shape), np.zeros(at.shape)
    place = np.clip(at / spacing, 0.0, len(values) - 1.0)
    i = np.minimum(place.astype(int), len(values) - 2)
    u = place - i
    a, b, m, n = values[i], values[i + 1], spacing * slopes[i], spacing * slopes[i + 1]
    rise = b - a
    # Hermite's cubic
    value = a + u * (m + u * (3.0 * rise - 2.0 * m - n + u * (m + n - 2.0 * rise)))
    slope = m + u * (2.0 * (3.0 * rise - 2.0 * m - n) + 3.0 * u * (m + n - 2.0 * rise))
    second = 2.0 * (3.0 * rise - 2.0 * m - n) + 6.0 * u * (m + n - 2.0 * rise)
    return value, slope / spacing, second / spacing**2
