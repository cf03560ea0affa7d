"""Rigid transforms in space, as on /tf, and their planar components."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from diffdrive_mpc.models.interface import FloatArray

_CHORD_COSINE = 1.0 - 1e-9
"""Cosine of the angle between two quaternions above which they are interpolated linearly [-]."""


class Rigid(NamedTuple):
    """Transform from coordinates in the child frame to coordinates in the parent frame: rotation, then translation.

    Attributes
    ----------
    x, y, z
        Translation [m].
    qx, qy, qz, qw
        Unit quaternion of the rotation [-].
    """

    x: float
    y: float
    z: float
    qx: float
    qy: float
    qz: float
    qw: float

    def after(self, first: Rigid) -> Rigid:
        """Return the composition that applies `first`, then this transform."""
        ax, ay, az, aw = self[3:]
        bx, by, bz, bw = first[3:]
        dx, dy, dz = _rotate(self, first.x, first.y, first.z)
        return Rigid(
            self.x + dx,
            self.y + dy,
            self.z + dz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
            aw * bw - ax * bx - ay * by - az * bz,
        )

    def inverse(self) -> Rigid:
        """Return the inverse transform, from the parent frame to the child frame."""
        rotation = Rigid(0.0, 0.0, 0.0, -self.qx, -self.qy, -self.qz, self.qw)
        x, y, z = _rotate(rotation, self.x, self.y, self.z)
        return rotation._replace(x=-x, y=-y, z=-z)

    def towards(self, target: Rigid, share: float) -> Rigid:
        """Interpolate between this transform (`share` = 0) and `target` (`share` = 1).

        The position is interpolated linearly, the attitude along the shortest arc.
        """
        start, end = np.array(self[3:]), np.array(target[3:])
        cosine = float(start @ end)
        # q and -q are the same rotation; the shorter arc has a positive cosine.
        if cosine < 0.0:
            end, cosine = -end, -cosine
        if cosine > _CHORD_COSINE:
            attitude = start + share * (end - start)
        else:
            angle = math.acos(cosine)
            attitude = (math.sin((1.0 - share) * angle) * start + math.sin(share * angle) * end) / math.sin(angle)
        attitude /= np.linalg.norm(attitude)
        x, y, z = (a + share * (b - a) for a, b in zip(self[:3], target[:3], strict=True))
        return Rigid(x, y, z, *attitude.tolist())

    @property
    def yaw(self) -> float:
        """Heading of the child's x axis in the parent's x-y plane [rad]."""
        return math.atan2(
            2.0 * (self.qw * self.qz + self.qx * self.qy), 1.0 - 2.0 * (self.qy * self.qy + self.qz * self.qz)
        )

    @property
    def vertical(self) -> tuple[float, float, float]:
        """Parent's z axis (3,) in coordinates of the child frame [-]."""
        x, y, z, w = self[3:]
        return 2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)

    @property
    def planar(self) -> FloatArray:
        """(3,) x, y [m], yaw [rad]."""
        return np.array([self.x, self.y, self.yaw])


IDENTITY = Rigid(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


def _rotate(rotation: Rigid, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Rotate a vector v by the quaternion q = (u, w): v + 2 w (u x v) + 2 u x (u x v)."""
    ux, uy, uz, w = rotation[3:]
    cx, cy, cz = uy * z - uz * y, uz * x - ux * z, ux * y - uy * x
    return (
        x + 2.0 * (w * cx + uy * cz - uz * cy),
        y + 2.0 * (w * cy + uz * cx - ux * cz),
        z + 2.0 * (w * cz + ux * cy - uy * cx),
    )
