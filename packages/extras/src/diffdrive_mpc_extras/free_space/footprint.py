"""The outline of the robot on the floor."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc_extras.free_space.polygons import hull

_MOST = 32


@dataclass(frozen=True, eq=False)
class Footprint:
    """The convex hull of some points, widened all round by a radius.

    Attributes
    ----------
    polygon
        (k, 2) points x, y seen from the base point [m], in any order; one point and a radius are a disc.
    radius
        By how much their hull is widened [m].

    Raises
    ------
    ValueError
        If it is no footprint.
    """

    polygon: Sequence[Sequence[float]]
    radius: float = 0.0
    corners: FloatArray = field(init=False, repr=False)
    """(k, 2) of the hull, counter-clockwise [m]"""

    def __post_init__(self) -> None:
        """Check it and find the hull."""
        try:
            points = np.array(self.polygon, dtype=float).reshape(-1, 2)
        except (TypeError, ValueError) as error:
            raise ValueError("footprint: its corners are no pairs of numbers; give x, y of each [m]") from error
        if not 1 <= len(points) <= _MOST:
            raise ValueError(f"footprint: {len(points)} corners; give 1 to {_MOST}")
        if not (np.isfinite(points).all() and np.isfinite(self.radius) and self.radius >= 0.0):
            raise ValueError("footprint: corners and radius have to be finite, and the radius not negative")
        corners = hull(points)
        if len(corners) < 3 and self.radius == 0.0:
            raise ValueError("footprint: it has no area; give three corners that are not in a line, or a radius")
        object.__setattr__(self, "corners", corners)

    @classmethod
    def rectangle(cls, length: float, width: float, ahead: float = 0.0) -> Footprint:
        """A rectangle [m] whose middle lies `ahead` [m] of the base point."""
        x, y = 0.5 * length, 0.5 * width
        return cls(((ahead + x, y), (ahead - x, y), (ahead - x, -y), (ahead + x, -y)))

    @classmethod
    def discs(cls, discs: Sequence[tuple[float, float, float]]) -> Footprint:
        """What covers discs x, y, radius [m]: the hull of their middles, widened by the largest radius."""
        return cls([disc[:2] for disc in discs], max(disc[2] for disc in discs))

    @property
    def reach(self) -> float:
        """Distance from the base point to the farthest point of it [m]."""
        return float(np.hypot(*self.corners.T).max()) + self.radius
