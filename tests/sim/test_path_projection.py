"""Lateral errors of all points at once are those of one point after the other."""

import numpy as np

from diffdrive_mpc.sim.metrics.path_projection import Polyline

WINDOW = 0.6


def one_after_the_other(path, points, arc_length):
    """As `Polyline.lateral` describes it: (n,) distances [m] without their sides."""
    distances, piece = [], None
    for i, point in enumerate(points):
        near = (path.arc_end >= arc_length[i] - WINDOW) & (path.arc_start <= arc_length[i] + WINDOW)
        if piece is not None:
            # Between there and the place where the point before was nearest, widened by twice the way since.
            by = min(WINDOW, 2.0 * np.hypot(*(point - points[i - 1])))
            before = (path.arc_end >= path.arc_start[piece] - by) & (path.arc_start <= path.arc_end[piece] + by)
            looked_at = np.flatnonzero(near | before)
            near[looked_at[0] : looked_at[-1] + 1] = True
        away = point - path.start
        along = np.clip((away * path.direction).sum(axis=1), 0.0, path.length)
        gaps = np.where(near, np.hypot(*(away - along[:, None] * path.direction).T), np.inf)
        piece = int(gaps.argmin())
        distances.append(gaps[piece])
    return distances


def test_points_are_projected_as_one_after_the_other():
    """Along a drawn path, on it, beside it, and far behind, where each search hangs on the one before."""
    draw = np.random.default_rng(0)
    for _ in range(60):
        corners = np.cumsum(draw.normal(0.0, 0.3, (40, 2)) + [0.1, 0.0], axis=0)
        steps = np.diff(corners, axis=0)
        length = np.hypot(*steps.T)
        arc = np.concatenate([[0.0], np.cumsum(length)])
        path = Polyline(corners[:-1], steps / length[:, None], length, arc[:-1], arc[1:])
        # The robot falls behind the place where it is expected, by a share that is drawn, and is led away at times.
        expected = np.linspace(0.0, 0.9 * arc[-1], draw.integers(2, 80))
        there = expected * draw.uniform(0.3, 1.0)
        points = np.column_stack([np.interp(there, arc, corners[:, i]) for i in (0, 1)])
        points = points + draw.choice([0.0, 0.02, 0.5]) * draw.normal(size=points.shape)
        wanted = one_after_the_other(path, points, expected)
        assert np.allclose(np.abs(path.lateral(points, expected, WINDOW)), wanted, rtol=0.0, atol=1e-9)
