"""Polygons in the plane: area, convex hull, self-intersection, and convex decomposition."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from diffdrive_mpc.models.interface import FloatArray

# Distance up to which two corners coincide [m].
_COINCIDENT = 1e-9


def area(corners: FloatArray) -> float:
    """Compute the signed area of a polygon (k, 2) [m^2]; positive for counter-clockwise order."""
    x, y = corners.T
    return 0.5 * float(x @ np.roll(y, -1) - y @ np.roll(x, -1))


def hull(points: FloatArray) -> FloatArray:
    """Compute the corners (k, 2) of the convex hull of points (n, 2), counter-clockwise; two for collinear points.

    Source: Andrew, Information Processing Letters 9(5), 1979.
    """
    ordered = sorted({(float(x), float(y)) for x, y in points})
    if len(ordered) < 3:
        return np.array(ordered, dtype=float).reshape(-1, 2)

    def chain(line: list[tuple[float, float]]) -> list[tuple[float, float]]:
        corners: list[tuple[float, float]] = []
        for point in line:
            while len(corners) > 1 and _turn(corners[-2], corners[-1], point) <= 0.0:
                corners.pop()
            corners.append(point)
        return corners[:-1]

    return np.array(chain(ordered) + chain(ordered[::-1]), dtype=float)


def _turn(a: tuple[float, float], b: tuple[float, float], c: tuple[float, float]) -> float:
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])


def cleaned(corners: FloatArray) -> FloatArray:
    """Remove corners that coincide with the previous one."""
    return np.asarray(corners[np.hypot(*(corners - np.roll(corners, 1, axis=0)).T) > _COINCIDENT], dtype=float)


def crosses_itself(corners: FloatArray) -> bool:
    """Return True if two edges of a polygon (k, 2) that are not adjacent meet."""
    a, b = corners, np.roll(corners, -1, axis=0)
    along = b - a

    def side(point: FloatArray) -> FloatArray:
        """Return (k, k) signs; entry [i, j] is the side of edge i on which point j lies."""
        d = point[None, :, :] - a[:, None, :]
        return np.asarray(np.sign(along[:, None, 0] * d[..., 1] - along[:, None, 1] * d[..., 0]))

    starts, ends = side(a), side(b)
    straddles = starts * ends <= 0
    meets = straddles & straddles.T
    # Collinear edges meet only if their bounding boxes overlap.
    low, high = np.minimum(a, b), np.maximum(a, b)
    boxes = ((low[:, None] <= high[None]) & (low[None] <= high[:, None])).all(axis=2)
    count = len(corners)
    i, j = np.indices((count, count))
    neighbours = (i == j) | ((i + 1) % count == j) | ((j + 1) % count == i)
    return bool((meets & boxes & ~neighbours).any())


def convex_pieces(corners: FloatArray) -> list[FloatArray]:
    """Split a simple polygon (k, 2) into convex pieces, counter-clockwise: one piece if it is convex, else triangles.

    Source (ear clipping): Meisters, The American Mathematical Monthly 82(6), 1975.
    """
    ring = [tuple(point) for point in (corners if area(corners) > 0 else corners[::-1]).tolist()]
    turns = [_turn(ring[i - 1], ring[i], ring[(i + 1) % len(ring)]) for i in range(len(ring))]
    if min(turns) >= 0.0:
        return [hull(np.array(ring))]
    pieces = []
    while len(ring) > 3:
        ear = next((i for i in range(len(ring)) if _is_ear(ring, i)), None)
        if ear is None:
            # Rounding can leave no ear; the hull covers the remaining corners.
            break
        pieces.append(np.array([ring[ear - 1], ring[ear], ring[(ear + 1) % len(ring)]]))
        del ring[ear]
    pieces.append(hull(np.array(ring)))
    return [piece for piece in pieces if len(piece) > 1]


def _is_ear(ring: list[tuple[float, float]], i: int) -> bool:
    a, b, c = ring[i - 1], ring[i], ring[(i + 1) % len(ring)]
    if _turn(a, b, c) < 0.0:
        return False
    inside = (
        _turn(a, b, p) >= 0.0 and _turn(b, c, p) >= 0.0 and _turn(c, a, p) >= 0.0 for p in ring if p not in (a, b, c)
    )
    return not any(inside)


_MAX_CORNERS = 32


@dataclass(frozen=True, eq=False)
class Footprint:
    """Footprint of a robot: the convex hull of points, inflated by a radius.

    Attributes
    ----------
    polygon
        (k, 2) points x, y relative to the base point [m], in any order; one point and a radius define a disc.
    radius
        Radius by which the hull is inflated [m].

    Raises
    ------
    ValueError
        If there are too few or too many points, a value is not finite, or the footprint has no area.
    """

    polygon: Sequence[Sequence[float]]
    radius: float = 0.0
    corners: FloatArray = field(init=False, repr=False)
    """(k, 2) corners of the hull, counter-clockwise [m]."""

    def __post_init__(self) -> None:
        """Check the points and compute their hull."""
        try:
            points = np.array(self.polygon, dtype=float).reshape(-1, 2)
        except (TypeError, ValueError) as error:
            raise ValueError("footprint: a corner is not a pair of numbers; give x, y of each [m]") from error
        if not 1 <= len(points) <= _MAX_CORNERS:
            raise ValueError(f"footprint: {len(points)} corners; give 1 to {_MAX_CORNERS}")
        if not (np.isfinite(points).all() and np.isfinite(self.radius) and self.radius >= 0.0):
            raise ValueError("footprint: corners and radius must be finite, and the radius not negative")
        corners = hull(points)
        if len(corners) < 3 and self.radius == 0.0:
            raise ValueError("footprint: it has no area; give three corners that are not in a line, or a radius")
        object.__setattr__(self, "corners", corners)

    @classmethod
    def rectangle(cls, length: float, width: float, ahead: float = 0.0) -> Footprint:
        """Build a rectangle [m] whose centre is `ahead` [m] in front of the base point."""
        x, y = 0.5 * length, 0.5 * width
        return cls(((ahead + x, y), (ahead - x, y), (ahead - x, -y), (ahead + x, -y)))

    @classmethod
    def discs(cls, discs: Sequence[tuple[float, float, float]]) -> Footprint:
        """Build a footprint that covers discs x, y, radius [m]: the hull of the centres, with the maximum radius."""
        return cls([disc[:2] for disc in discs], max(disc[2] for disc in discs))

    @property
    def reach(self) -> float:
        """Distance from the base point to the farthest point of the footprint [m]."""
        return float(np.hypot(*self.corners.T).max()) + self.radius
