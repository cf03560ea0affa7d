"""Lateral error: the distance of a point from the path, found by projection onto a polyline."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import ArrayLike, NDArray

from diffdrive_mpc.models.interface import FloatArray, Reference

# Distances of points from segments that are worked out at once: as many as fit into a processor's cache.
_AT_ONCE = 20_000
_EQUALLY_NEAR, _LEEWAY = 1e-12, 1e-9  # [m]
# Of searches that change; on its path a robot needs one or two.
_ROUNDS = 4


@dataclass(frozen=True, slots=True)
class Polyline:
    """A path as straight segments, continued straight beyond both ends.

    Without the continuation, a robot slightly before the start or after the end would get its distance along the path
    as a lateral error.

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
        """Compute the signed distance of points from the path, positive to its left.

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
        lateral = np.full(len(points), np.nan)
        finite = np.flatnonzero(np.isfinite(points).all(axis=1))
        points, arc_length = points[finite], arc_length[finite]
        first = np.searchsorted(self.arc_end, arc_length - window)
        last = np.searchsorted(self.arc_start, arc_length + window, side="right")
        # On the inside of a bend the nearest place is faster than the point; of a leap it makes no search.
        moved = np.diff(points, axis=0)
        reach = np.minimum(window, 2.0 * np.hypot(moved[:, 0], moved[:, 1]))
        start, end = first.copy(), last.copy()
        nearest, pieces = np.empty(len(points)), np.empty(len(points), dtype=np.intp)

        def search(rows: NDArray[np.intp]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
            """Choose the segments for points from the segments of the previous points."""
            before, by = pieces[rows - 1], reach[rows - 1]
            begins = np.minimum(first[rows], np.searchsorted(self.arc_end, self.arc_start[before] - by))
            ends = np.maximum(last[rows], np.searchsorted(self.arc_start, self.arc_end[before] + by, side="right"))
            return begins, ends

        # Search all at once, and again those whose search range depends on the results. For a lost robot that is done
        # point by point.
        later = np.arange(1, len(points))
        rows = np.arange(len(points))
        for _ in range(_ROUNDS):
            if not rows.size:
                break
            nearest[rows], pieces[rows] = self._nearest(points[rows], start[rows], end[rows])
            begins, ends = search(later)
            rows = later[(begins != start[1:]) | (ends != end[1:])]
            start[1:], end[1:] = begins, ends
        for row in range(rows[0] if rows.size else len(points), len(points)):
            rows = np.array([row])
            nearest[rows], pieces[rows] = self._nearest(points[rows], *search(rows))
        lateral[finite] = nearest
        return lateral

    def _nearest(
        self, points: FloatArray, start: NDArray[np.intp], end: NDArray[np.intp]
    ) -> tuple[FloatArray, NDArray[np.intp]]:
        """Return (n,) signed distances [m] of `points` (n, 2) from segments `start` to `end`, and the nearest of these.

        Of several that are equally near it is the first.
        """
        distance, segment = np.empty(len(points)), np.empty(len(points), dtype=np.intp)
        some = max(1, _AT_ONCE // max(1, int(np.max(end - start))))
        for first in range(0, len(points), some):
            part = slice(first, first + some)
            distance[part], segment[part] = self._nearest_at_once(points[part], start[part], end[part])
        return distance, segment

    def _nearest_at_once(
        self, points: FloatArray, start: NDArray[np.intp], end: NDArray[np.intp]
    ) -> tuple[FloatArray, NDArray[np.intp]]:
        width = int(np.max(end - start))
        since = np.minimum(start, len(self.length) - width)
        place = since[:, None] + np.arange(width)

        def windows(values: FloatArray) -> FloatArray:
            """Return windows (n, width) of the segments from `since` on."""
            return sliding_window_view(values, width)[since]

        ux, uy = windows(self.direction[:, 0]), windows(self.direction[:, 1])
        x, y = points[:, :1] - windows(self.start[:, 0]), points[:, 1:] - windows(self.start[:, 1])
        along = np.minimum(np.maximum(x * ux + y * uy, 0.0), windows(self.length))
        across, behind = x - along * ux, y - along * uy
        square = across * across + behind * behind
        square[(place < start[:, None]) | (place >= end[:, None])] = np.inf
        # Squares are quick, and sort out all that can be neither the nearest nor as near: the rest exactly.
        row, k = np.nonzero(square <= (np.sqrt(square.min(axis=1, keepdims=True)) + _LEEWAY) ** 2)
        gap = np.hypot(across[row, k], behind[row, k])
        _, first = np.unique(row, return_index=True)
        least = np.minimum.reduceat(gap, first)
        nearest = np.flatnonzero(gap == least[row])
        _, first = np.unique(row[nearest], return_index=True)
        # At a vertex two segments are equally near, and each may see the point straight ahead: their sum decides.
        near = gap <= least[row] + _EQUALLY_NEAR
        row_near, k_near = row[near], k[near]
        left = (ux[row_near, k_near] * y[row_near, k_near]) - (uy[row_near, k_near] * x[row_near, k_near])
        side = np.bincount(row_near, left, len(points))
        return np.copysign(least, side), since + k[nearest[first]]


def path_polyline(reference: Reference, spacing: float, extension: float) -> Polyline:
    """Lay a polyline along the path of `reference`.

    Parameters
    ----------
    reference
        The trajectory; places of standing or turning on the spot become one vertex.
    spacing
        Largest distance between two vertices [m].
    extension
        Length by which the path is continued straight beyond its ends [m].
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
