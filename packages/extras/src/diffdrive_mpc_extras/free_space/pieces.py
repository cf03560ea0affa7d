"""Convex pieces of the surroundings, in memory shared with C, and their clearances from a footprint."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from diffdrive_mpc import core_sources
from diffdrive_mpc.models.compiled.packaged import Packaged, loaded_once
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
"""Number of stage parameters: a (2), point d (2) in the frame of the robot [m], b [m]."""

_FOLDER = Path(__file__).parent


def half_space(pose: ca.SX, parameters: ca.SX) -> ca.SX:
    """Return the signed distance of the point d of the robot from a plane [m]; it is negative on the free side.

    The distance is a . (position + R(heading) d) - b; the unit vector a is the normal towards the blocked side.
    """
    a, d, b = parameters[:2], parameters[2:4], parameters[4]
    cosine, sine = ca.cos(pose[2]), ca.sin(pose[2])
    point = pose[:2] + ca.vertcat(cosine * d[0] - sine * d[1], sine * d[0] + cosine * d[1])
    return ca.SX(ca.dot(a, point) - b)


def half_space_c_function() -> ca.Function:
    """Return the function of C that computes the half-space distance and its gradient."""
    inputs = core_sources.term_symbols(PARAMETERS)
    return core_sources.term("ddmpc_f_half_space", inputs, half_space(inputs["pose"], inputs["parameters"]))


def half_space_function() -> ca.Function:
    """Return the half-space distance as a CasADi function of the pose and the stage parameters."""
    pose, parameters = ca.SX.sym("pose", 3), ca.SX.sym("parameters", PARAMETERS)
    return ca.Function(
        "half_space", [pose, parameters], [half_space(pose, parameters)], ["pose", "parameters"], ["value"]
    )


@loaded_once
def load_free_space() -> tuple[Any, Any]:
    """Return the cffi declarations and the free-space library from the wheel, or compile it at the first use.

    Raises
    ------
    NotCompiledError
        If the wheel contains no library and no C compiler is installed.
    """
    ffi, _ = core_sources.load_core()
    header = (_FOLDER / "free_space.h").read_text(encoding="utf-8")
    return ffi, core_sources.load_with_core(_packaged(), _texts, header)


def packaged_libraries() -> Iterator[Path]:
    """Yield the libraries of the wheel that this processor supports, fastest first."""
    return _packaged().libraries()


def write_packaged(folder: Path) -> list[Path]:
    """Compile the free-space libraries of the wheel and write them with a manifest into `folder`.

    Raises
    ------
    NotCompiledError
        If the compilation fails.
    """
    return _packaged().write(_texts(), folder)


def _packaged() -> Packaged:
    sources = [path.read_text(encoding="utf-8") for path in [*sorted(_FOLDER.glob("*.[ch]")), Path(__file__)]]
    return core_sources.packaged_with_core("ddmpc_free_space", _FOLDER, sources)


def _texts() -> dict[str, str]:
    """Return the texts of all C files and headers by name, including the core and the generated files."""
    generated = core_sources.generate((half_space_c_function(),), "ddmpc_half_space", "free_space/pieces.py")
    written = {path.name: path.read_text(encoding="utf-8") for path in sorted(_FOLDER.glob("*.[ch]"))}
    return (
        core_sources.core_texts()
        | written
        | {
            f"{generated.stem}.c": generated.source,
            f"{generated.stem}.h": generated.header,
        }
    )


_MARGIN = 100.0  # width of the occupied region surroundings a grid [m]
_WALL_STEP = 0.1  # distance between two points of a corridor's wall [m]
_MAX_WALL_POINTS = 5000


@dataclass(frozen=True, eq=False)
class Pieces:
    """Convex pieces: their corners, radii, velocities and names.

    Attributes
    ----------
    corners
        (k, 2) corners of each of the n pieces, counter-clockwise [m].
    widening
        (n,) radius by which each piece is inflated [m].
    velocity
        (n, 2) velocity of each piece [m/s].
    names
        Names of the pieces in messages.
    """

    corners: Sequence[FloatArray]
    widening: FloatArray
    velocity: FloatArray
    names: Sequence[str]
    struct: Any = field(init=False, repr=False)
    """Structure of C that points to the arrays."""
    _arrays: tuple[Any, ...] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        """Copy the pieces into arrays for C, with the bounding circle of each piece."""
        ffi, _ = load_free_space()
        count = len(self.corners)
        ends = np.cumsum([0, *(len(corners) for corners in self.corners)]).astype(np.intc)
        corner = np.concatenate([*self.corners, np.zeros((1, 2))])
        circle = np.zeros((count + 1, 3))
        if count:
            starts = ends[:-1]
            low, high = (reduce.reduceat(corner[:-1], starts) for reduce in (np.minimum, np.maximum))
            circle[:-1, :2] = 0.5 * (low + high)
            distance = np.hypot(*(corner[:-1] - np.repeat(circle[:-1, :2], np.diff(ends), axis=0)).T)
            circle[:-1, 2] = np.maximum.reduceat(distance, starts) + self.widening
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
        object.__setattr__(self, "_arrays", arrays)

    def __len__(self) -> int:
        """Return the number of pieces."""
        return len(self.corners)

    def select(self, mask: NDArray[np.bool_]) -> Pieces:
        """Return the pieces selected by a (n,) mask."""
        indices = np.flatnonzero(mask).tolist()
        return Pieces(
            [self.corners[i] for i in indices],
            self.widening[indices],
            self.velocity[indices],
            [self.names[i] for i in indices],
        )


@dataclass(frozen=True, eq=False)
class PlacedFootprint:
    """Footprint in memory shared with C."""

    footprint: Footprint
    struct: Any = field(init=False, repr=False)
    _arrays: FloatArray = field(init=False, repr=False)

    def __post_init__(self) -> None:
        """Copy the corners into an array for C."""
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
        object.__setattr__(self, "_arrays", corners)


PieceCache = dict[int, tuple[object, list[FloatArray]]]
"""Cache of pieces: the polygon or grid and its pieces, by the identity of the object."""


def build_pieces(
    surroundings: Surroundings, config: FreeSpace, reference: Reference | None = None, cache: PieceCache | None = None
) -> Pieces:
    """Build the convex pieces of `surroundings`; a corridor is built only with its reference.

    `cache` holds the pieces of the previous call; an object that is in the cache is not decomposed again.

    Raises
    ------
    SurroundingsError
        If an object is invalid, or if there are more than `config.max_pieces` pieces.
    """
    time = surroundings.time
    if time is not None and not np.isfinite(time):
        raise SurroundingsError(f"surroundings: time is {time}; give seconds on the clock of step, or None")
    corners: list[FloatArray] = []
    widening: list[float] = []
    velocity: list[tuple[float, float]] = []
    names: list[str] = []

    def add(pieces: Sequence[FloatArray], name: str) -> None:
        corners.extend(pieces)
        widening.extend([0.0] * len(pieces))
        velocity.extend([(0.0, 0.0)] * len(pieces))
        names.extend([name] * len(pieces))

    previous, current = dict(cache or {}), PieceCache()

    def cached(source: object, make: Callable[[], list[FloatArray]]) -> list[FloatArray]:
        entry = previous.get(id(source))
        current[id(source)] = entry if entry is not None and entry[0] is source else (source, make())
        return current[id(source)][1]

    for index, polygon in enumerate(surroundings.polygons):
        name = f"polygon {index}"
        add(cached(polygon, partial(_polygon_pieces, polygon, name)), name)
    for index, disc in enumerate(surroundings.discs):
        name = f"disc {index}"
        check_disc(disc, name, timed=time is not None)
        corners.append(np.array([[disc.x, disc.y]], dtype=float))
        widening.append(float(disc.radius))
        velocity.append((float(disc.vx), float(disc.vy)))
        names.append(name)
    if surroundings.grid is not None:
        grid = surroundings.grid
        add(cached(grid, lambda: _grid_pieces(grid, config)), "occupied cells")
    if surroundings.corridor is not None and reference is not None:
        add(*_corridor_pieces(surroundings.corridor, reference))
    if len(corners) > config.max_pieces:
        raise SurroundingsError(
            f"surroundings: {len(corners)} convex pieces exceed the limit of {config.max_pieces}; give a smaller "
            "window or a coarser grid, or raise free_space.max_pieces"
        )
    if cache is not None:
        cache.clear()
        cache.update(current)
    return Pieces(corners, np.array(widening, dtype=float), np.array(velocity, dtype=float).reshape(-1, 2), names)


def _polygon_pieces(corners: ArrayLike, name: str) -> list[FloatArray]:
    return convex_pieces(checked_polygon(corners, name))


@dataclass(frozen=True, slots=True, eq=False)
class PreparedGrid(OccupancyGrid):
    """A grid whose occupied cells are cache as rectangles already.

    Attributes
    ----------
    boxes
        (n, 4, 2) corners of the rectangles [m].
    """

    boxes: FloatArray = field(default_factory=lambda: np.zeros((0, 4, 2)))


def prepared_grid(grid: OccupancyGrid, config: FreeSpace) -> PreparedGrid:
    """Compute the rectangles of `grid` and drop its cells, to send them to another process.

    Raises
    ------
    SurroundingsError
        If the grid is invalid or needs too many rectangles.
    """
    boxes = _grid_pieces(grid, config)
    stacked = np.stack(boxes) if boxes else np.zeros((0, 4, 2))
    return PreparedGrid(np.zeros((1, 1), dtype=np.int8), grid.resolution, grid.origin, stacked)


def _grid_pieces(grid: OccupancyGrid, config: FreeSpace) -> list[FloatArray]:
    """Return rectangles that cover exactly the occupied cells, (4, 2) corners each [m]."""
    if isinstance(grid, PreparedGrid):
        return list(grid.boxes)
    cells = checked_grid(grid, config.max_cells)
    occupied = cells >= config.occupied_from
    if not config.unknown_is_free:
        occupied |= cells < 0
    boxes = rectangles(occupied, config.max_pieces)
    if not config.unknown_is_free:
        rows, columns = occupied.shape
        far = int(_MARGIN / grid.resolution) + 1
        border = [
            (-far, -far, 0, columns + far),
            (rows, -far, rows + far, columns + far),
            (0, -far, rows, 0),
            (0, columns, rows, columns + far),
        ]
        boxes = np.vstack([boxes, np.array(border)])
    x, y, theta = grid.origin
    cosine, sine = np.cos(theta), np.sin(theta)
    rotation = np.array([[cosine, sine], [-sine, cosine]])
    pieces = []
    for row, column, row_end, column_end in (grid.resolution * boxes).tolist():
        box = np.array([[column, row], [column_end, row], [column_end, row_end], [column, row_end]])
        pieces.append(box @ rotation + [x, y])
    return pieces


def rectangles(occupied: NDArray[np.bool_], max_count: int = 2**31) -> NDArray[np.int64]:
    """Cover the occupied cells by rectangles, (n, 4): first row, first column, end row and end column (exclusive).

    Equal runs of occupied cells in consecutive rows are merged into one rectangle.

    Raises
    ------
    SurroundingsError
        If there are more than `max_count` rectangles.
    """
    edges = np.diff(np.pad(occupied.astype(np.int8), ((0, 0), (1, 1))), axis=1)
    row, start = np.nonzero(edges == 1)
    end = np.nonzero(edges == -1)[1]
    if len(row) == 0:
        return np.zeros((0, 4), dtype=np.int64)
    # Sorted by column, equal runs of consecutive rows are adjacent.
    order = np.lexsort((row, end, start))
    row, start, end = row[order], start[order], end[order]
    continues = (start[1:] == start[:-1]) & (end[1:] == end[:-1]) & (row[1:] == row[:-1] + 1)
    first = np.flatnonzero(np.concatenate([[True], ~continues]))
    last = np.append(first[1:], len(row)) - 1
    if len(first) > max_count:
        raise SurroundingsError(
            f"grid: {len(first)} rectangles of occupied cells exceed the limit of {max_count}; give a smaller window "
            "or a coarser grid, or raise free_space.max_pieces"
        )
    return np.stack([row[first], start[first], row[last] + 1, end[first]], axis=1).astype(np.int64)


def _corridor_pieces(corridor: Corridor, reference: Reference) -> tuple[list[FloatArray], str]:
    """Return the two walls as line segments, (2, 2) ends each [m], and their name in messages."""
    arc, left, right = checked_corridor(corridor)
    # The bounds also hold if the duration or the length overflows.
    times = np.linspace(0.0, reference.duration, int(min(reference.duration / 0.02 + 2, 20_000)))
    sample = reference.sample(times)
    count = int(min(float(arc[-1] - arc[0]) / _WALL_STEP + 2, _MAX_WALL_POINTS))
    arc_lengths = np.unique(np.concatenate([np.linspace(arc[0], arc[-1], count), arc[:_MAX_WALL_POINTS]]))
    # If the reference stops or turns in place, several times have the same arc length; any of them will do.
    pose = np.stack([np.interp(arc_lengths, sample.arc_length, column) for column in sample.pose.T], axis=1)
    side = np.stack([-np.sin(pose[:, 2]), np.cos(pose[:, 2])], axis=1)
    walls = []
    for width, sign in ((left, 1.0), (right, -1.0)):
        line = pose[:, :2] + sign * np.interp(arc_lengths, arc, width)[:, None] * side
        is_segment = np.hypot(*np.diff(line, axis=0).T) > 1e-6
        walls += [line[i : i + 2] for i in np.flatnonzero(is_segment)]
    return walls, "the corridor's edge"


# Clearances between a footprint and pieces, computed by the compiled library.


def address(array: NDArray[Any], kind: str = "const real *") -> Any:  # noqa: ANN401 - cffi has no types
    """Return the address of an array for C."""
    return load_free_space()[0].cast(kind, array.ctypes.data)


def min_gaps(
    footprint: PlacedFootprint, pieces: Pieces, poses: FloatArray, times: FloatArray, max_gap: float
) -> tuple[FloatArray, NDArray[np.intc]]:
    """Compute the minimum clearance at each pose, and the index of the nearest piece.

    `poses` is (k, 3) and `times` (k,) [s]. Returns (k,) clearances [m], clipped to `max_gap` [m], and (k,) indices, -1
    if no piece is closer than `max_gap`.
    """
    pose_array, time_array = np.ascontiguousarray(poses, dtype=float), np.ascontiguousarray(times, dtype=float)
    gaps, nearest = np.empty(len(pose_array)), np.empty(len(pose_array), dtype=np.intc)
    load_free_space()[1].ddmpc_clearances(
        footprint.struct,
        pieces.struct,
        len(pose_array),
        address(pose_array),
        address(time_array),
        max_gap,
        address(gaps, "real *"),
        address(nearest, "int *"),
    )
    return gaps, nearest
