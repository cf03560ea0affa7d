"""Lateral error: the distance of a point from the path, found by projection onto a polyline."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from diffdrive_mpc.models.interface import FloatArray, Reference


@dataclass(frozen=True, slots=True)
class Polyline:
    """A path as straight segments, continued straight beyond both ends.

    Without the continuation a robot that stands a little before the start or after the end would be charged its
    distance along the path as a lateral error.

    Attributes
    ----------
    start, direction
        (m, 2) first point [m] and unit vector of each segment.
    length
        (m,) length of each segment [m].
    arc_start, arc_end
        (m,) arc length of the path at both ends of each segment [m]; both increase.
    """

    start: FloatArray
    direction: FloatArray
    length: FloatArray
    arc_start: FloatArray
    arc_end: FloatArray

    def lateral(self, points: ArrayLike, arc_length: ArrayLike, window: float) -> FloatArray:
        """Signed distance of points from the path, positive to its left.

        Parameters
        ----------
        points
            (n, 2) positions [m].
        arc_length
            (n,) where along the path each point is expected [m].
        window
            Segments within this arc length of the expected place are looked at [m]. A robot far behind its reference is
            none the less found on its own part of the path: also looked at is what lies between these segments and the
            place where the point before was nearest, widened by twice the way from that point to this one.

        Returns
        -------
        FloatArray
            (n,) lateral errors [m]; NaN for points that are not finite.
        """
        points, arc_length = np.asarray(points, dtype=float), np.asarray(arc_length, dtype=float)
        first = np.searchsorted(self.arc_end, arc_length - window)
        last = np.searchsorted(self.arc_start, arc_length + window, side="right")
        lateral = np.full(len(points), np.nan)
        found, before = -1, points[:0]
        for i in np.flatnonzero(np.isfinite(points).all(axis=1)):
            begin, end = int(first[i]), int(last[i])
            if found >= 0:
                # On the inside of a bend the nearest place is faster than the point; of a leap it makes no search.
                reach = min(window, 2.0 * float(np.hypot(*(points[i] - before))))
                begin = min(begin, int(np.searchsorted(self.arc_end, self.arc_start[found] - reach)))
                end = max(end, int(np.searchsorted(self.arc_start, self.arc_end[found] + reach, side="right")))
            lateral[i], found = self._nearest(points[i], begin, end)
            before = points[i]
        return lateral

    def _nearest(self, point: FloatArray, begin: int, end: int) -> tuple[float, int]:
        """Signed distance [m] of `point` (2,) from the segments `begin` to `end`, and the first nearest of them."""
        part = slice(begin, end)
        direction, offset = self.direction[part], point - self.start[part]
        along = np.clip(np.einsum("ij,ij->i", offset, direction), 0.0, self.length[part])
        gap = offset - along[:, None] * direction
        distance = np.hypot(gap[:, 0], gap[:, 1])
        least = np.min(distance)
        # At a vertex two segments are equally near, and each may see the point straight ahead: their sum decides.
        side = np.sum((direction[:, 0] * offset[:, 1] - direction[:, 1] * offset[:, 0])[distance <= least + 1e-12])
        return float(np.copysign(least, side)), begin + int(np.argmin(distance))


def path_polyline(reference: Reference, spacing: float, extension: float) -> Polyline:
    """Lay a polyline along the path of `reference`.

    Parameters
    ----------
    reference
        The trajectory; places where it stands or turns on the spot become one vertex.
    spacing
        Largest distance between two vertices [m].
    extension
        How far the path is continued straight beyond its ends [m].
    """
    coarse = reference.sample(np.linspace(0.0, reference.duration, 1000))
    # The speed between coarse samples may be a little higher than at them; twice as many vertices cover that.
    steps = 2.0 * float(np.max(np.abs(coarse.twist[:, 0]))) * reference.duration / spacing
    path = reference.sample(np.linspace(0.0, reference.duration, max(2, int(np.ceil(steps)) + 1)))
    moved = np.flatnonzero(np.diff(path.arc_length, prepend=-np.inf) > 1e-9)
    points, arc = path.pose[moved, :2], path.arc_length[moved]
    ends = path.pose[[0, -1], 2]
    heading = np.column_stack([np.cos(ends), np.sin(ends)])
    before = points[1] - points[0] if len(points) > 1 else heading[0]
    after = points[-1] - points[-2] if len(points) > 1 else heading[1]
    points = np.vstack(
        [
            points[0] - extension * before / np.linalg.norm(before),
            points,
            points[-1] + extension * after / np.linalg.norm(after),
        ]
    )
    arc = np.concatenate([[arc[0] - extension], arc, [arc[-1] + extension]])
    edges = np.diff(points, axis=0)
    length = np.linalg.norm(edges, axis=1)
    return Polyline(points[:-1], edges / length[:, None], length, arc[:-1], arc[1:])
