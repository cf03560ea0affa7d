"""Lateral errors, which are signed distances of points from a path, by projection onto a polyline."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from diffdrive_mpc.models.interface import FloatArray, Reference
from diffdrive_mpc.sim.core.library import address, load_twin


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
        points, arc_length = np.ascontiguousarray(points[finite]), arc_length[finite]
        first = np.searchsorted(self.arc_end, arc_length - window)
        last = np.searchsorted(self.arc_start, arc_length + window, side="right")
        # The factor 2 is necessary because the projection moves faster than the point on the inside of a bend. The
        # window limits the search range after a jump of the pose.
        steps = np.diff(points, axis=0, prepend=points[:1])
        margin = np.minimum(window, 2.0 * np.hypot(steps[:, 0], steps[:, 1]))
        ffi, library = load_twin()
        arrays = {name: np.ascontiguousarray(getattr(self, name)) for name in self.__slots__}
        line = ffi.new("polyline *", {name: address(array) for name, array in arrays.items()})
        line.segments = len(self.length)
        ranges = [ffi.from_buffer("long long[]", ends.astype(np.longlong)) for ends in (first, last)]
        distance = np.empty(len(points))
        library.polyline_lateral(line, len(points), address(points), *ranges, address(margin), address(distance))
        lateral[finite] = distance
        return lateral


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
    vertices = np.flatnonzero(np.diff(path.arc_length, prepend=-np.inf) > 1e-9)
    points, arc = path.pose[vertices, :2], path.arc_length[vertices]
    headings = path.pose[[0, -1], 2]
    directions = np.column_stack([np.cos(headings), np.sin(headings)])
    first = points[1] - points[0] if len(points) > 1 else directions[0]
    last = points[-1] - points[-2] if len(points) > 1 else directions[1]
    points = np.vstack(
        [
            points[0] - extension * first / np.linalg.norm(first),
            points,
            points[-1] + extension * last / np.linalg.norm(last),
        ]
    )
    arc = np.concatenate([[arc[0] - extension], arc, [arc[-1] + extension]])
    edges = np.diff(points, axis=0)
    length = np.linalg.norm(edges, axis=1)
    return Polyline(points[:-1], edges / length[:, None], length, arc[:-1], arc[1:])
