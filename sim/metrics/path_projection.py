"""Lateral error, which is the distance of a point from the path, by projection onto a polyline."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import ArrayLike, NDArray

from diffdrive_mpc.models.interface import FloatArray, Reference

# Maximum number of distances that are computed at once, so that the data fit into the processor's cache.
_BATCH_SIZE = 20_000
_TIE_TOLERANCE, _CANDIDATE_TOLERANCE = 1e-12, 1e-9  # [m]
# Maximum number of rounds of vectorised searches; one or two are sufficient for a robot near its path.
_MAX_ROUNDS = 4


@dataclass(frozen=True, slots=True)
class Polyline:
    """Polyline approximation of a path with straight extensions at both ends.

    Without the extensions, the distance of a robot slightly before the start or after the end of the path would count
    as lateral error.

    Attributes
    ----------
    start, direction
        (m, 2) start point [m] and unit vector of each segment.
    length
        (m,) length of each segment [m].
    arc_start, arc_end
        (m,) increasing arc lengths of the path at both ends of each segment [m].
    """

    start: FloatArray
    direction: FloatArray
    length: FloatArray
    arc_start: FloatArray
    arc_end: FloatArray

    def lateral(self, points: ArrayLike, arc_length: ArrayLike, window: float) -> FloatArray:
        """Compute the signed distances of points from the path, positive to the left of the path.

        Parameters
        ----------
        points
            (n, 2) positions [m].
        arc_length
            (n,) expected position of each point on the path [m].
        window
            Arc length before and after the expected position in which segments are searched [m]. The search also
            includes the segments up to the nearest segment of the previous point, extended by twice the distance
            between both points, so that a robot far behind its reference is projected onto the correct part of the
            path.

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
        # On the inside of a bend the projection moves faster than the point; the range after a jump is limited.
        moved = np.diff(points, axis=0)
        reach = np.minimum(window, 2.0 * np.hypot(moved[:, 0], moved[:, 1]))
        start, end = first.copy(), last.copy()
        nearest, pieces = np.empty(len(points)), np.empty(len(points), dtype=np.intp)

        def search(rows: NDArray[np.intp]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
            """Return the ranges of segments to search, from the nearest segments of the previous points."""
            before, margin = pieces[rows - 1], reach[rows - 1]
            starts = np.minimum(first[rows], np.searchsorted(self.arc_end, self.arc_start[before] - margin))
            ends = np.maximum(last[rows], np.searchsorted(self.arc_start, self.arc_end[before] + margin, side="right"))
            return starts, ends

        # Search for all points at once, and repeat the search for points whose range changes with the results. After
        # the maximum number of rounds, for instance for a robot far from its path, search point by point.
        later = np.arange(1, len(points))
        rows = np.arange(len(points))
        for _ in range(_MAX_ROUNDS):
            if not rows.size:
                break
            nearest[rows], pieces[rows] = self._nearest(points[rows], start[rows], end[rows])
            starts, ends = search(later)
            rows = later[(starts != start[1:]) | (ends != end[1:])]
            start[1:], end[1:] = starts, ends
        for row in range(rows[0] if rows.size else len(points), len(points)):
            rows = np.array([row])
            nearest[rows], pieces[rows] = self._nearest(points[rows], *search(rows))
        lateral[finite] = nearest
        return lateral

    def _nearest(
        self, points: FloatArray, start: NDArray[np.intp], end: NDArray[np.intp]
    ) -> tuple[FloatArray, NDArray[np.intp]]:
        """Compute signed distances (n,) [m] of `points` (n, 2) from segments `start` to `end`, and nearest segments.

        If several segments are equally near, the first is returned.
        """
        distance, segment = np.empty(len(points)), np.empty(len(points), dtype=np.intp)
        batch = max(1, _BATCH_SIZE // max(1, int(np.max(end - start))))
        for first in range(0, len(points), batch):
            part = slice(first, first + batch)
            distance[part], segment[part] = self._nearest_in_batch(points[part], start[part], end[part])
        return distance, segment

    def _nearest_in_batch(
        self, points: FloatArray, start: NDArray[np.intp], end: NDArray[np.intp]
    ) -> tuple[FloatArray, NDArray[np.intp]]:
        width = int(np.max(end - start))
        offset = np.minimum(start, len(self.length) - width)
        index = offset[:, None] + np.arange(width)

        def windows(values: FloatArray) -> FloatArray:
            """Return windows (n, width) of the values of the segments, starting at `offset`."""
            return sliding_window_view(values, width)[offset]

        ux, uy = windows(self.direction[:, 0]), windows(self.direction[:, 1])
        x, y = points[:, :1] - windows(self.start[:, 0]), points[:, 1:] - windows(self.start[:, 1])
        along = np.minimum(np.maximum(x * ux + y * uy, 0.0), windows(self.length))
        offset_x, offset_y = x - along * ux, y - along * uy
        square = offset_x * offset_x + offset_y * offset_y
        square[(index < start[:, None]) | (index >= end[:, None])] = np.inf
        # Squared distances exclude most segments; exact distances are computed only for the remaining candidates.
        row, k = np.nonzero(square <= (np.sqrt(square.min(axis=1, keepdims=True)) + _CANDIDATE_TOLERANCE) ** 2)
        gap = np.hypot(offset_x[row, k], offset_y[row, k])
        _, first = np.unique(row, return_index=True)
        minimum = np.minimum.reduceat(gap, first)
        nearest = np.flatnonzero(gap == minimum[row])
        _, first = np.unique(row[nearest], return_index=True)
        # At a vertex, two segments are equally near, and the point may be collinear with one of them, so the sum of
        # both determines the sign.
        near = gap <= minimum[row] + _TIE_TOLERANCE
        row_near, k_near = row[near], k[near]
        left = (ux[row_near, k_near] * y[row_near, k_near]) - (uy[row_near, k_near] * x[row_near, k_near])
        side = np.bincount(row_near, left, len(points))
        return np.copysign(minimum, side), offset + k[nearest[first]]


def path_polyline(reference: Reference, spacing: float, extension: float) -> Polyline:
    """Approximate the path of `reference` by a polyline.

    Parameters
    ----------
    reference
        Reference of the path; standstill and turns on the spot become a single vertex.
    spacing
        Maximum distance between two vertices [m].
    extension
        Length of the straight extension beyond each end [m].
    """
    coarse = reference.sample(np.linspace(0.0, reference.duration, 1000))
    # The speed between coarse samples may be slightly higher than at the samples, so twice as many vertices are used.
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
