"""Surroundings of the robot by a map, a costmap or other sensors."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from diffdrive_mpc.models.errors import DiffdriveMpcError
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc_extras.free_space.polygons import area, cleaned, crosses_itself

_MOST_CORNERS = 200
_FARTHEST = 1e6
# No wall and no person is faster [m/s]; a disc that is has a wrong unit.
_FASTEST = 50.0


class SurroundingsError(DiffdriveMpcError, ValueError):
    """Surroundings that cannot be used. The message is one line: what, mistake, remedy."""


@dataclass(frozen=True, slots=True)
class MovingDisc:
    """A disc that moves straight on.

    Attributes
    ----------
    x, y
        Middle at `Surroundings.time`, in the frame of the poses [m].
    radius
        [m].
    vx, vy
        Velocity in that frame [m/s]; zero: it stands.
    """

    x: float
    y: float
    radius: float
    vx: float = 0.0
    vy: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class OccupancyGrid:
    """Cells as in nav_msgs/OccupancyGrid.

    Attributes
    ----------
    cells
        (rows, columns) int8: -1 unknown, 0 free to 100 occupied; row 0 lies at the origin, columns go along x.
    resolution
        Edge of a cell [m].
    origin
        x, y [m], theta [rad] of the outer corner of cell (0, 0), in the frame of the poses.
    """

    cells: NDArray[np.int8]
    resolution: float
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True, eq=False)
class Corridor:
    """Free width to either side of the reference.

    Attributes
    ----------
    arc_length
        (n,) distances along the reference [m], increasing.
    left, right
        (n,) free width to the left and right of the reference's heading there [m], not negative; straight between.
    """

    arc_length: ArrayLike
    left: ArrayLike
    right: ArrayLike


@dataclass(frozen=True, slots=True, eq=False)
class Surroundings:
    """All obstacles of the robot; it replaces what was seen before.

    Polygons and grids that are the same objects as before are not worked out again: do not change them in place.

    Attributes
    ----------
    polygons
        (k, 2) corners of each obstacle, in either direction [m]; simple polygons, convex or not.
    discs
        Standing or moving obstacles.
    grid
        A costmap, or none.
    corridor
        Free width along the reference, or none.
    time
        Instant at which discs and grid were so, on the clock of `step` [s]. None: a map, which does not grow old; then
        no disc may move.
    """

    polygons: Sequence[ArrayLike] = ()
    discs: Sequence[MovingDisc] = ()
    grid: OccupancyGrid | None = None
    corridor: Corridor | None = None
    time: float | None = None


def checked_polygon(corners: ArrayLike, name: str) -> FloatArray:
    """Return the polygon (k, 2) as numbers.

    Raises
    ------
    SurroundingsError
        If it is none: too few corners, no numbers, no area, or it crosses itself.
    """
    points = _numbers(corners, name)
    if points.ndim != 2 or points.shape[1] != 2:
        raise SurroundingsError(f"{name}: corners of shape {points.shape}; give x, y of each [m]")
    if not 3 <= len(points) <= _MOST_CORNERS:
        raise SurroundingsError(f"{name}: {len(points)} corners; give 3 to {_MOST_CORNERS}, or split it")
    _require_place(points, name)
    points = cleaned(points)
    if crosses_itself(points):
        raise SurroundingsError(f"{name}: its edges cross each other; give the corners in their order round it")
    if len(points) < 3 or abs(area(points)) < 1e-12:
        raise SurroundingsError(f"{name}: it has no area; give corners that are not in a line")
    return points


def check_disc(disc: MovingDisc, name: str, *, timed: bool) -> None:
    """Raise SurroundingsError where a disc cannot be one."""
    values = _numbers((disc.x, disc.y, disc.vx, disc.vy, disc.radius), name)
    _require_place(values[:2], name)
    if not np.isfinite(values).all():
        raise SurroundingsError(f"{name}: its velocity or radius is not finite; leave out unknown values")
    if not 0.0 <= disc.radius <= 1e3:
        raise SurroundingsError(f"{name}: radius {disc.radius:g} m; give 0 to 1000")
    speed = math.hypot(disc.vx, disc.vy)
    if speed > _FASTEST:
        raise SurroundingsError(f"{name}: {speed:.3g} m/s is faster than {_FASTEST:g}; velocities are in m/s")
    if speed > 0.0 and not timed:
        raise SurroundingsError(f"{name}: it moves, and its position has no time; give surroundings a time")


def checked_grid(grid: OccupancyGrid, max_cells: int) -> NDArray[np.int8]:
    """Return the cells.

    Raises
    ------
    SurroundingsError
        If it has none or too many, or values, resolution or origin that no grid has.
    """
    shape = np.shape(grid.cells)
    if len(shape) != 2 or 0 in shape:
        raise SurroundingsError(f"grid: cells of shape {shape}; give rows and columns")
    if shape[0] * shape[1] > max_cells:
        raise SurroundingsError(
            f"grid: {shape[0]} x {shape[1]} cells, at most {max_cells:,} are taken; give a smaller window around the "
            "robot, or raise free_space.max_cells"
        )
    resolution, origin = _numbers(grid.resolution, "grid"), _numbers(grid.origin, "grid")
    if resolution.shape != () or not 1e-3 <= float(resolution) <= 10.0:
        raise SurroundingsError(f"grid: resolution {grid.resolution!r} m; give 0.001 to 10")
    if origin.shape != (3,):
        raise SurroundingsError(f"grid: origin of shape {origin.shape}; give x, y [m], theta [rad]")
    _require_place(origin, "grid: its origin")
    cells = np.asarray(grid.cells)
    if cells.dtype.kind not in "iu":
        raise SurroundingsError(f"grid: cells of type {cells.dtype}; give int8, -1 for unknown, 0 to 100")
    low, high = int(cells.min()), int(cells.max())
    if low < -1 or high > 100:
        raise SurroundingsError(f"grid: cells from {low} to {high}; give -1 for unknown, 0 to 100")
    return cells.astype(np.int8, copy=False)


def checked_corridor(corridor: Corridor) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the three columns (n,) of a corridor.

    Raises
    ------
    SurroundingsError
        If they do not fit each other, are not finite, not increasing, or negative.
    """
    arc, left, right = (_numbers(getattr(corridor, name), "corridor") for name in ("arc_length", "left", "right"))
    if not (arc.ndim == 1 and arc.shape == left.shape == right.shape) or not 2 <= len(arc) <= 100_000:
        raise SurroundingsError(
            f"corridor: arc_length, left and right have shapes {arc.shape}, {left.shape}, {right.shape}; give as many "
            "numbers of each, at least two"
        )
    if not all(np.isfinite(column).all() for column in (arc, left, right)):
        raise SurroundingsError("corridor: it contains a value that is not finite")
    if not (np.diff(arc) > 0.0).all():
        raise SurroundingsError("corridor: arc_length does not increase")
    if min(left.min(), right.min()) < 0.0:
        raise SurroundingsError("corridor: a width is negative; both are distances from the reference")
    return arc, left, right


def _numbers(value: object, name: str) -> FloatArray:
    try:
        return np.asarray(value, dtype=float)
    except (TypeError, ValueError, OverflowError) as error:
        raise SurroundingsError(f"{name}: it contains a value that is not a number") from error


def _require_place(values: FloatArray, name: str) -> None:
    if not np.isfinite(values).all():
        raise SurroundingsError(f"{name}: it contains a value that is not finite")
    if np.abs(values).max() > _FARTHEST:
        raise SurroundingsError(f"{name}: it lies more than {_FARTHEST:g} m away; lengths are in m")
