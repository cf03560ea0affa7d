"""Way and plan as shapes in a MuJoCo scene, and paths as meshes of its floor."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.pose import wrap_angle
from diffdrive_mpc.sim.view.body import Line, load_looks

_SPACING = 0.05  # [m], of the points of lines
_THIN = 0.0005  # [m], half the thickness of what lies on the floor
_CUSP = 2.0  # [rad], of a turn that no corner of a path has
_WAY_HEIGHT = 0.004  # [m], over the floor


def draw_marks(scene: Any, way: FloatArray, plan: FloatArray, height: float) -> None:  # noqa: ANN401 - has no types
    """Append to a `mjvScene` the `way` (m, 2) so far and the `plan` (p, 2) [m]; either may be empty.

    The plan is drawn at `height` [m], above the robot that would hide it. What does not fit into the scene is left out.
    """
    looks = load_looks().marks
    _line(scene, thinned(way, _SPACING), looks.way, _WAY_HEIGHT)
    _line(scene, plan, looks.plan, height)


def ribbon(path: FloatArray, half_width: float) -> tuple[FloatArray, NDArray[np.intp]]:
    """A strip along `path` (n, 2) [m]: its points (2 m, 2) [m], right and left in turn, and triangles (k, 3) of them.

    It ends and begins anew where the path turns back on itself: a robot that stops and reverses.
    """
    path = thinned(path, _SPACING)
    steps = np.diff(path, axis=0)
    direction = np.arctan2(steps[:, 1], steps[:, 0])
    turned = wrap_angle(np.diff(direction))
    cusps = 1 + np.flatnonzero(np.abs(turned) > _CUSP)
    points, triangles, begun = [], [], 0
    for first, last in itertools.pairwise([0, *cusps.tolist(), len(steps)]):
        half = 0.5 * np.concatenate([[0.0], turned[first : last - 1], [0.0]])
        normal = direction[np.minimum(np.arange(first, last + 1), last - 1)] - half + np.pi / 2
        left = (half_width / np.cos(half))[:, None] * np.column_stack([np.cos(normal), np.sin(normal)])
        piece = path[first : last + 1]
        points.append(np.stack([piece - left, piece + left], axis=1).reshape(-1, 2))
        each = begun + 2 * np.arange(last - first)[:, None]
        triangles += [each + (0, 2, 3), each + (0, 3, 1)]
        begun += len(points[-1])
    return np.concatenate(points), np.concatenate(triangles)


def thinned(points: FloatArray, spacing: float) -> FloatArray:
    """Those of `points` (n, 2) that are at least `spacing` [m] along the way from the one before, and the last."""
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) < 2:
        return points[:0]
    travelled = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
    kept = np.unique(np.searchsorted(travelled, np.arange(0.0, travelled[-1], spacing)))
    kept = np.append(kept, np.searchsorted(travelled, travelled[-1]))
    kept = kept[np.diff(travelled[kept], prepend=-1.0) > 0.0]
    return points[kept] if len(kept) > 1 else points[:0]


def _line(scene: Any, points: FloatArray, line: Line, height: float) -> None:  # noqa: ANN401
    _ribbon(scene, points, (*line.colour, 1.0), line.radius, height)


def _ribbon(scene: Any, points: FloatArray, colour: Sequence[float], half_width: float, height: float) -> None:  # noqa: ANN401
    """Flat boxes from each of `points` (n, 2) to the next, their tops at `height` [m]."""
    import mujoco  # noqa: PLC0415 - optional

    rgba = np.array(colour, dtype=np.float32)
    steps = np.diff(points, axis=0)
    for middle, (dx, dy) in zip(0.5 * (points[1:] + points[:-1]), steps, strict=True):
        length = float(np.hypot(dx, dy))
        if scene.ngeom >= scene.maxgeom or length == 0.0:
            continue
        c, s = dx / length, dy / length
        turned = np.array([c, -s, 0.0, s, c, 0.0, 0.0, 0.0, 1.0])
        half, at = np.array([length / 2, half_width, _THIN]), np.array([*middle, height])
        mujoco.mjv_initGeom(scene.geoms[scene.ngeom], mujoco.mjtGeom.mjGEOM_BOX, half, at, turned, rgba)
        scene.ngeom += 1
