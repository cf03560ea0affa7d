"""Surroundings as convex pieces in the memory that C reads."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cache, partial
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from diffdrive_mpc import core_sources
from diffdrive_mpc.models.compiled.packaged import Packaged
from diffdrive_mpc.models.interface import FloatArray, Reference
from diffdrive_mpc_extras.free_space.config import FreeSpace
from diffdrive_mpc_extras.free_space.polygons import Footprint, convex_pieces
from diffdrive_mpc_extras.free_space.surroundings import (
    Corridor,
    OccupancyGrid,
    Surroundings,
    SurroundingsError,
    check_disc,
    checked_corridor,
    checked_grid,
    checked_polygon,
)

core_sources.require(1)

PARAMETERS = 5
"""Number of stage parameters: a (2), point d (2) of the robot in its own frame [m], b [m]."""

_FOLDER = Path(__file__).parent


def half_space(pose: ca.SX, parameters: ca.SX) -> ca.SX:
    """Return the distance of the point d of the robot beyond a plane [m], no more than zero on the free side.

    It is a . (position + R(heading) d) - b, where a is a unit vector that leads to the far side.
    """
    a, d, b = parameters[:2], parameters[2:4], parameters[4]
    cosine, sine = ca.cos(pose[2]), ca.sin(pose[2])
    point = pose[:2] + ca.vertcat(cosine * d[0] - sine * d[1], sine * d[0] + cosine * d[1])
    return ca.SX(ca.dot(a, point) - b)


def half_space_formula() -> ca.Function:
    """Return that distance with its gradient, as it is in C."""
    inputs = core_sources.term_symbols(PARAMETERS)
    return core_sources.term("ddmpc_f_half_space", inputs, half_space(inputs["pose"], inputs["parameters"]))


def half_space_function() -> ca.Function:
    """Return that distance as a function that a term takes."""
    pose, parameters = ca.SX.sym("pose", 3), ca.SX.sym("parameters", PARAMETERS)
    return ca.Function(
        "half_space", [pose, parameters], [half_space(pose, parameters)], ["pose", "parameters"], ["value"]
    )


@cache
def load_free_space() -> tuple[Any, Any]:
    """Return cffi's declarations and the library of free space: of the wheel, else compiled with the core at first use.

    Raises
    ------
    NotCompiledError
        If the wheel holds no library, and there is no C compiler.
    """
    ffi, _ = core_sources.load_core()
    header = (_FOLDER / "free_space.h").read_text(encoding="utf-8")
    return ffi, core_sources.load_with_core(_packaged(), _texts, header)


def packaged_libraries() -> Iterator[Path]:
    """Yield the libraries of the wheel that this processor can run, best first."""
    return _packaged().libraries()


def write_packaged(folder: Path) -> list[Path]:
    """Compile free space for the wheel in `folder`: libraries and manifest.

    Raises
    ------
    NotCompiledError
        If it cannot be compiled.
    """
    return _packaged().write(_texts(), folder)


def _packaged() -> Packaged:
    sources = [path.read_text(encoding="utf-8") for path in [*sorted(_FOLDER.glob("*.[ch]")), Path(__file__)]]
    return core_sources.packaged_with_core("ddmpc_free_space", _FOLDER, sources)


def _texts() -> dict[str, str]:
    """Return all C files and headers by name, those of the core and the generated ones included."""
    generated = core_sources.generate((half_space_formula(),), "ddmpc_half_space", "free_space/pieces.py")
    written = {path.name: path.read_text(encoding="utf-8") for path in sorted(_FOLDER.glob("*.[ch]"))}
    return (
        core_sources.core_texts()
        | written
        | {
            f"{generated.stem}.c": generated.source,
            f"{generated.stem}.h": generated.header,
        }
    )


_AROUND = 100.0  # width of the region beyond a grid, where that is occupied [m]
_WALL_STEP = 0.1  # between two points of a corridor's wall [m]
_MOST_WALLS = 5000


@dataclass(frozen=True, eq=False)
class Pieces:
    """Convex pieces: their corners, radii, velocities and names.

    Attributes
    ----------
    corners
        (k, 2) of each piece, counter-clockwise [m].
    widening
        (n,) [m].
    velocity
        (n, 2) [m/s].
    names
        For messages.
    """

    corners: Sequence[FloatArray]
    widening: FloatArray
    velocity: FloatArray
    names: Sequence[str]
    struct: Any = field(init=False, repr=False)
    """for C"""
    _kept: tuple[Any, ...] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        """Lay them out in memory."""
        ffi, _ = load_free_space()
        count = len(self.corners)
        ends = np.cumsum([0, *(len(corners) for corners in self.corners)]).astype(np.intc)
        corner = np.concatenate([*self.corners, np.zeros((1, 2))])
        circle = np.zeros((count + 1, 3))
        if count:
            begins = ends[:-1]
            low, high = (reduce.reduceat(corner[:-1], begins) for reduce in (np.minimum, np.maximum))
            circle[:-1, :2] = 0.5 * (low + high)
            away = np.hypot(*(corner[:-1] - np.repeat(circle[:-1, :2], np.diff(ends), axis=0)).T)
            circle[:-1, 2] = np.maximum.reduceat(away, begins) + self.widening
        widening, velocity = np.append(self.widening, 0.0), np.vstack([self.velocity.reshape(-1, 2), np.zeros((1, 2))])
        arrays = (ends, corner, widening, velocity, circle)

        def pointer(array: NDArray[Any], kind: str = "const real *") -> Any:  # noqa: ANN401 - cffi has no types
            return ffi.cast(kind, array.ctypes.data)

        struct = ffi.new(
            "ddmpc_surroundings *",
            {
                "pieces": count,
                "first": pointer(ends, "const int *"),
                "corner": pointer(corner),
                "widening": pointer(widening),
                "velocity": pointer(velocity),
                "circle": pointer(circle),
            },
        )
        object.__setattr__(self, "struct", struct)
        object.__setattr__(self, "_kept", arrays)

    def __len__(self) -> int:
        """Return the number of pieces."""
        return len(self.corners)

    def chosen(self, which: NDArray[np.bool_]) -> Pieces:
        """Select some of the pieces."""
        places = np.flatnonzero(which).tolist()
        return Pieces(
            [self.corners[i] for i in places],
            self.widening[places],
            self.velocity[places],
            [self.names[i] for i in places],
        )


@dataclass(frozen=True, eq=False)
class PlacedFootprint:
    """A footprint in the memory that C reads."""

    footprint: Footprint
    struct: Any = field(init=False, repr=False)
    _kept: FloatArray = field(init=False, repr=False)

    def __post_init__(self) -> None:
        """Lay it out."""
        ffi, _ = load_free_space()
        corners = np.ascontiguousarray(self.footprint.corners)
        struct = ffi.new(
            "ddmpc_footprint *",
            {
                "corners": len(corners),
                "corner": ffi.cast("const real *", corners.ctypes.data),
                "widening": self.footprint.radius,
                "reach": self.footprint.reach,
            },
        )
        object.__setattr__(self, "struct", struct)
        object.__setattr__(self, "_kept", corners)


Known = dict[int, tuple[object, list[FloatArray]]]
"""Results for polygons and grids, by identity."""


def pieces_of(
    around: Surroundings, config: FreeSpace, reference: Reference | None = None, known: Known | None = None
) -> Pieces:
    """Build the convex pieces of `around`; a corridor needs its reference.

    Pieces of an object from the last call, given with `known`, are not computed again.

    Raises
    ------
    SurroundingsError
        If something in it cannot be used, or it has more pieces than are taken.
    """
    time = around.time
    if time is not None and not np.isfinite(time):
        raise SurroundingsError(f"surroundings: their time is {time}; give seconds on the clock of step, or None")
    corners: list[FloatArray] = []
    widening: list[float] = []
    velocity: list[tuple[float, float]] = []
    names: list[str] = []

    def add(added: Sequence[FloatArray], name: str) -> None:
        corners.extend(added)
        widening.extend([0.0] * len(added))
        velocity.extend([(0.0, 0.0)] * len(added))
        names.extend([name] * len(added))

    before, now = dict(known or {}), Known()

    def once(source: object, make: Callable[[], list[FloatArray]]) -> list[FloatArray]:
        former = before.get(id(source))
        now[id(source)] = former if former is not None and former[0] is source else (source, make())
        return now[id(source)][1]

    for index, polygon in enumerate(around.polygons):
        name = f"polygon {index}"
        add(once(polygon, partial(_of_polygon, polygon, name)), name)
    for index, disc in enumerate(around.discs):
        name = f"disc {index}"
        check_disc(disc, name, timed=time is not None)
        corners.append(np.array([[disc.x, disc.y]], dtype=float))
        widening.append(float(disc.radius))
        velocity.append((float(disc.vx), float(disc.vy)))
        names.append(name)
    if around.grid is not None:
        grid = around.grid
        add(once(grid, lambda: _of_grid(grid, config)), "occupied cells")
    if around.corridor is not None and reference is not None:
        add(*_of_corridor(around.corridor, reference))
    if len(corners) > config.max_pieces:
        raise SurroundingsError(
            f"surroundings: {len(corners)} convex pieces, at most {config.max_pieces} are taken; give a smaller "
            "window or a coarser grid, or raise free_space.max_pieces"
        )
    if known is not None:
        known.clear()
        known.update(now)
    return Pieces(corners, np.array(widening, dtype=float), np.array(velocity, dtype=float).reshape(-1, 2), names)


def _of_polygon(corners: ArrayLike, name: str) -> list[FloatArray]:
    return convex_pieces(checked_polygon(corners, name))


@dataclass(frozen=True, slots=True, eq=False)
class PreparedGrid(OccupancyGrid):
    """A grid whose occupied cells are known as rectangles already.

    Attributes
    ----------
    boxes
        (n, 4, 2) their corners [m].
    """

    boxes: FloatArray = field(default_factory=lambda: np.zeros((0, 4, 2)))


def prepared_grid(grid: OccupancyGrid, config: FreeSpace) -> PreparedGrid:
    """Compute the rectangles of `grid` and drop its cells: for another process.

    Raises
    ------
    SurroundingsError
        If it cannot be used.
    """
    boxes = _of_grid(grid, config)
    stacked = np.stack(boxes) if boxes else np.zeros((0, 4, 2))
    return PreparedGrid(np.zeros((1, 1), dtype=np.int8), grid.resolution, grid.origin, stacked)


def _of_grid(grid: OccupancyGrid, config: FreeSpace) -> list[FloatArray]:
    """Build rectangles that cover exactly the occupied cells."""
    if isinstance(grid, PreparedGrid):
        return list(grid.boxes)
    cells = checked_grid(grid, config.max_cells)
    occupied = cells >= config.occupied_from
    if not config.unknown_is_free:
        occupied |= cells < 0
    boxes = rectangles(occupied, config.max_pieces)
    if not config.unknown_is_free:
        rows, columns = occupied.shape
        far = int(_AROUND / grid.resolution) + 1
        beyond = [
            (-far, -far, 0, columns + far),
            (rows, -far, rows + far, columns + far),
            (0, -far, rows, 0),
            (0, columns, rows, columns + far),
        ]
        boxes = np.vstack([boxes, np.array(beyond)])
    x, y, theta = grid.origin
    cosine, sine = np.cos(theta), np.sin(theta)
    turned = np.array([[cosine, sine], [-sine, cosine]])
    placed = []
    for row, column, row_end, column_end in (grid.resolution * boxes).tolist():
        box = np.array([[column, row], [column_end, row], [column_end, row_end], [column, row_end]])
        placed.append(box @ turned + [x, y])
    return placed


def rectangles(occupied: NDArray[np.bool_], most: int = 2**31) -> NDArray[np.int64]:
    """Cover the occupied cells by rectangles: (n, 4) row, column, and the row and column after the last.

    Runs of a row that are the same in the next rows are one rectangle.

    Raises
    ------
    SurroundingsError
        If there are more than `most`.
    """
    edges = np.diff(np.pad(occupied.astype(np.int8), ((0, 0), (1, 1))), axis=1)
    row, start = np.nonzero(edges == 1)
    end = np.nonzero(edges == -1)[1]
    if len(row) == 0:
        return np.zeros((0, 4), dtype=np.int64)
    # In the order of their columns, continued runs are adjacent.
    order = np.lexsort((row, end, start))
    row, start, end = row[order], start[order], end[order]
    goes_on = (start[1:] == start[:-1]) & (end[1:] == end[:-1]) & (row[1:] == row[:-1] + 1)
    first = np.flatnonzero(np.concatenate([[True], ~goes_on]))
    last = np.append(first[1:], len(row)) - 1
    if len(first) > most:
        raise SurroundingsError(
            f"grid: its occupied cells are {len(first)} rectangles, at most {most} are taken; give a smaller window "
            "or a coarser grid, or raise free_space.max_pieces"
        )
    return np.stack([row[first], start[first], row[last] + 1, end[first]], axis=1).astype(np.int64)


def _of_corridor(corridor: Corridor, reference: Reference) -> tuple[list[FloatArray], str]:
    """Build its walls as pieces of straight lines."""
    arc, left, right = checked_corridor(corridor)
    # Lengths as large as numbers go overflow here; there is a bound anyway.
    times = np.linspace(0.0, reference.duration, int(min(reference.duration / 0.02 + 2, 20_000)))
    sample = reference.sample(times)
    count = int(min(float(arc[-1] - arc[0]) / _WALL_STEP + 2, _MOST_WALLS))
    arc_lengths = np.unique(np.concatenate([np.linspace(arc[0], arc[-1], count), arc[:_MOST_WALLS]]))
    # Where the reference stands or turns, many times have the same arc length: any of them.
    pose = np.stack([np.interp(arc_lengths, sample.arc_length, column) for column in sample.pose.T], axis=1)
    side = np.stack([-np.sin(pose[:, 2]), np.cos(pose[:, 2])], axis=1)
    walls = []
    for width, sign in ((left, 1.0), (right, -1.0)):
        line = pose[:, :2] + sign * np.interp(arc_lengths, arc, width)[:, None] * side
        apart = np.hypot(*np.diff(line, axis=0).T) > 1e-6
        walls += [line[i : i + 2] for i in np.flatnonzero(apart)]
    return walls, "the corridor's edge"


# Gaps between a footprint and pieces, worked out by the compiled library.


def address(array: NDArray[Any], kind: str = "const real *") -> Any:  # noqa: ANN401 - cffi has no types
    """Return the address of an array for C."""
    return load_free_space()[0].cast(kind, array.ctypes.data)


def least_gaps(
    footprint: PlacedFootprint, pieces: Pieces, poses: FloatArray, times: FloatArray, enough: float
) -> tuple[FloatArray, NDArray[np.intc]]:
    """Compute least gaps (k,) at poses (k, 3), at most `enough` [m], and the nearest pieces; -1 without one."""
    placed, instants = np.ascontiguousarray(poses, dtype=float), np.ascontiguousarray(times, dtype=float)
    gaps, nearest = np.empty(len(placed)), np.empty(len(placed), dtype=np.intc)
    load_free_space()[1].ddmpc_clearances(
        footprint.struct,
        pieces.struct,
        len(placed),
        address(placed),
        address(instants),
        enough,
        address(gaps, "real *"),
        address(nearest, "int *"),
    )
    return gaps, nearest
