"""Surroundings of the robot: polygons, discs, an occupancy grid and a corridor, with their checks."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from diffdrive_mpc.models.errors import DiffdriveMpcError
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc_extras.free_space.polygons import area, cleaned, crosses_itself

_MAX_CORNERS = 200
_MAX_DISTANCE = 1e6
# Maximum plausible speed of a disc [m/s]; a higher value points to a wrong unit.
_MAX_SPEED = 50.0


class SurroundingsError(DiffdriveMpcError, ValueError):
    """Error for invalid surroundings. The message is one line: object, mistake, remedy."""


@dataclass(frozen=True, slots=True)
class MovingDisc:
    """Disc that moves at constant velocity.

    Attributes
    ----------
    x, y
        Centre at `Surroundings.time`, in the frame of the poses [m].
    radius
        Radius [m].
    vx, vy
        Velocity in the frame of the poses [m/s]; zero for a standing disc.
    """

    x: float
    y: float
    radius: float
    vx: float = 0.0
    vy: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class OccupancyGrid:
    """Occupancy grid with cells as in nav_msgs/OccupancyGrid.

    Attributes
    ----------
    cells
        (rows, columns) int8: -1 unknown, 0 free to 100 occupied; row 0 is at the origin, columns are along x.
    resolution
        Edge length of a cell [m].
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
        (n,) increasing arc lengths along the reference [m].
    left, right
        (n,) free width to the left and right of the reference [m], not negative; interpolated linearly.
    """

    arc_length: ArrayLike
    left: ArrayLike
    right: ArrayLike


@dataclass(frozen=True, slots=True, eq=False)
class Surroundings:
    """All obstacles around the robot; a new value replaces the previous surroundings.

    Polygons and grids are cached by object identity, so do not change them in place.

    Attributes
    ----------
    polygons
        (k, 2) corners of each obstacle, in either direction [m]; simple polygons, convex or not.
    discs
        Standing or moving obstacles.
    grid
        Costmap, or None.
    corridor
        Free width along the reference, or None.
    time
        Time of discs and grid on the clock of `step` [s]. None for a map that never becomes stale; discs must then
        stand still.
    """

    polygons: Sequence[ArrayLike] = ()
    discs: Sequence[MovingDisc] = ()
    grid: OccupancyGrid | None = None
    corridor: Corridor | None = None
    time: float | None = None


def checked_polygon(corners: ArrayLike, name: str) -> FloatArray:
    """Check a polygon and return its corners (k, 2) [m].

    Raises
    ------
    SurroundingsError
        If it has too few or too many corners, values that are not finite numbers, no area, or crossing edges.
    """
    points = _numbers(corners, name)
    if points.ndim != 2 or points.shape[1] != 2:
        raise SurroundingsError(f"{name}: corners of shape {points.shape}; give x, y of each [m]")
    if not 3 <= len(points) <= _MAX_CORNERS:
        raise SurroundingsError(f"{name}: {len(points)} corners; give 3 to {_MAX_CORNERS}, or split it")
    _check_position(points, name)
    points = cleaned(points)
    if crosses_itself(points):
        raise SurroundingsError(f"{name}: its edges cross each other; give the corners in order along the boundary")
    if len(points) < 3 or abs(area(points)) < 1e-12:
        raise SurroundingsError(f"{name}: it has no area; give corners that are not in a line")
    return points


def check_disc(disc: MovingDisc, name: str, *, timed: bool) -> None:
    """Raise SurroundingsError if a disc is invalid, or if it moves and the surroundings have no time."""
    values = _numbers((disc.x, disc.y, disc.vx, disc.vy, disc.radius), name)
    _check_position(values[:2], name)
    if not np.isfinite(values).all():
        raise SurroundingsError(f"{name}: its velocity or radius is not finite; leave out unknown values")
    if not 0.0 <= disc.radius <= 1e3:
        raise SurroundingsError(f"{name}: radius {disc.radius:g} m; give 0 to 1000")
    speed = math.hypot(disc.vx, disc.vy)
    if speed > _MAX_SPEED:
        raise SurroundingsError(f"{name}: {speed:.3g} m/s is faster than {_MAX_SPEED:g}; velocities are in m/s")
    if speed > 0.0 and not timed:
        raise SurroundingsError(f"{name}: it moves, and its position has no time; give surroundings a time")


def checked_grid(grid: OccupancyGrid, max_cells: int) -> NDArray[np.int8]:
    """Check a grid and return its cells as int8.

    Raises
    ------
    SurroundingsError
        If it has no cells or more than `max_cells`, or if a value, the resolution or the origin is out of range.
    """
    shape = np.shape(grid.cells)
    if len(shape) != 2 or 0 in shape:
        raise SurroundingsError(f"grid: cells of shape {shape}; give rows and columns")
    if shape[0] * shape[1] > max_cells:
        raise SurroundingsError(
            f"grid: {shape[0]} x {shape[1]} cells exceed the limit of {max_cells:,}; give a smaller window around the "
            "robot, or raise free_space.max_cells"
        )
    resolution, origin = _numbers(grid.resolution, "grid"), _numbers(grid.origin, "grid")
    if resolution.shape != () or not 1e-3 <= float(resolution) <= 10.0:
        raise SurroundingsError(f"grid: resolution {grid.resolution!r} m; give 0.001 to 10")
    if origin.shape != (3,):
        raise SurroundingsError(f"grid: origin of shape {origin.shape}; give x, y [m], theta [rad]")
    _check_position(origin, "grid: its origin")
    cells = np.asarray(grid.cells)
    if cells.dtype.kind not in "iu":
        raise SurroundingsError(f"grid: cells of type {cells.dtype}; give int8, -1 for unknown, 0 to 100")
    low, high = int(cells.min()), int(cells.max())
    if low < -1 or high > 100:
        raise SurroundingsError(f"grid: cells from {low} to {high}; give -1 for unknown, 0 to 100")
    return cells.astype(np.int8, copy=False)


def checked_corridor(corridor: Corridor) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Check a corridor and return its three columns, (n,) each.

    Raises
    ------
    SurroundingsError
        If the lengths differ, a value is not finite, arc lengths do not increase, or a width is negative.
    """
    arc, left, right = (_numbers(getattr(corridor, name), "corridor") for name in ("arc_length", "left", "right"))
    if not (arc.ndim == 1 and arc.shape == left.shape == right.shape) or not 2 <= len(arc) <= 100_000:
        raise SurroundingsError(
            f"corridor: arc_length, left and right have shapes {arc.shape}, {left.shape}, {right.shape}; give three "
            "arrays of equal length, at least two values each"
        )
    if not all(np.isfinite(column).all() for column in (arc, left, right)):
        raise SurroundingsError("corridor: it contains a value that is not finite")
    if not (np.diff(arc) > 0.0).all():
        raise SurroundingsError("corridor: arc_length does not increase")
    if min(left.min(), right.min()) < 0.0:
        raise SurroundingsError("corridor: a width is negative; give distances from the reference to each side")
    return arc, left, right


def _numbers(value: object, name: str) -> FloatArray:
    try:
        return np.asarray(value, dtype=float)
    except (TypeError, ValueError, OverflowError) as error:
        raise SurroundingsError(f"{name}: it contains a value that is not a number") from error


def _check_position(values: FloatArray, name: str) -> None:
    if not np.isfinite(values).all():
        raise SurroundingsError(f"{name}: it contains a value that is not finite")
    if np.abs(values).max() > _MAX_DISTANCE:
        raise SurroundingsError(f"{name}: it is more than {_MAX_DISTANCE:g} m from the origin; lengths are in m")
