"""Worlds that a seed draws: fields of posts of graded density with a way through them that a planner has found.

The idea is that of the BARN benchmark: D. Perille, A. Truong, X. Xiao, P. Stone, "Benchmarking metric ground
navigation", SSRR 2020. A cellular automaton clusters a random field; a world without a way for the disc around the
robot is drawn again. In `drawn:SEED` the smooth path is free and may pass near obstacles. In `drawn:SEED:through` posts
have been put onto that path afterwards, as after the planner has looked: there is a way around them near the field.
"""

from __future__ import annotations

import heapq
import math
from dataclasses import dataclass
from functools import cache, lru_cache
from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.interpolate import CubicSpline
from scipy.ndimage import convolve, distance_transform_edt

from diffdrive_mpc.models.checked_yaml import ConfigError, StrictModel, load_checked
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc_extras.worlds.shapes import Post, Shapes
from diffdrive_mpc_extras.worlds.world import Way, World

_STEPS = tuple((i, j, math.hypot(i, j)) for i in (-1, 0, 1) for j in (-1, 0, 1) if (i, j) != (0, 0))


@dataclass(frozen=True, eq=False)
class ObstacleDistanceGrid:
    """Distance from the nearest obstacle on a grid.

    Attributes
    ----------
    origin
        (2,) x, y of the first cell's middle [m].
    resolution
        Distance of cells [m].
    clearance
        (rows, columns) [m], rows along y; outside there is nothing.
    """

    origin: FloatArray
    resolution: float
    clearance: FloatArray

    @classmethod
    def build(cls, shapes: Shapes, low: FloatArray, high: FloatArray, resolution: float) -> ObstacleDistanceGrid:
        """Build the grid of a rectangle from `low` to `high` (2,) [m]; it is exact at the middles of the cells."""
        columns, rows = (np.ceil((high - low) / resolution).astype(int) + 1).tolist()
        x, y = low[0] + resolution * np.arange(columns), low[1] + resolution * np.arange(rows)
        points = np.column_stack([axis.ravel() for axis in np.meshgrid(x, y)])
        return cls(np.asarray(low, dtype=float), resolution, shapes.distance(points).reshape(rows, columns))

    def cell(self, point: FloatArray) -> tuple[int, int]:
        """Return row and column of the nearest cell."""
        column, row = np.rint((np.asarray(point) - self.origin) / self.resolution).astype(int).tolist()
        rows, columns = self.clearance.shape
        return min(max(row, 0), rows - 1), min(max(column, 0), columns - 1)

    def way(
        self,
        start: FloatArray,
        goal: FloatArray,
        radius: float,
        *,
        comfort: float = 0.0,
        only: NDArray[np.bool_] | None = None,
    ) -> FloatArray | None:
        """Find the best path (n, 2) [m] for a disc of `radius` [m]; None without one.

        Parameters
        ----------
        start, goal
            (2,) x, y [m].
        radius
            Cells nearer than this to an obstacle are forbidden [m].
        comfort
            Up to this much more clearance a cell is dearer, twice at none [m].
        only
            (rows, columns) cells that may be used; None for all.
        """
        free = self.clearance > radius
        if only is not None:
            free = free & only
        cost = np.ones_like(self.clearance)
        if comfort > 0:
            cost += np.clip(1.0 - (self.clearance - radius) / comfort, 0.0, 1.0)
        cells = _astar(free, cost, self.cell(start), self.cell(goal))
        if cells is None:
            return None
        return self.origin + self.resolution * np.array(cells, dtype=float)[:, ::-1]


def near(grid: ObstacleDistanceGrid, way: FloatArray, distance: float) -> NDArray[np.bool_]:
    """Mark the cells (rows, columns) within `distance` [m] of the points of a path."""
    away = np.ones(grid.clearance.shape, dtype=bool)
    for point in way:
        away[grid.cell(point)] = False
    return np.asarray(distance_transform_edt(away) * grid.resolution <= distance)


def _astar(
    free: NDArray[np.bool_], cost: FloatArray, start: tuple[int, int], goal: tuple[int, int]
) -> list[tuple[int, int]] | None:
    """Find cells from start to goal over eight neighbours; None without a path."""
    if not (free[start] and free[goal]):
        return None
    rows, columns = free.shape
    best = {start: 0.0}
    came: dict[tuple[int, int], tuple[int, int]] = {}
    done: set[tuple[int, int]] = set()
    waiting = [(0.0, start)]
    while waiting:
        _, cell = heapq.heappop(waiting)
        if cell == goal:
            cells = [cell]
            while cell in came:
                cell = came[cell]
                cells.append(cell)
            return cells[::-1]
        if cell in done:
            continue
        done.add(cell)
        for i, j, length in _STEPS:
            row, column = cell[0] + i, cell[1] + j
            if not (0 <= row < rows and 0 <= column < columns and free[row, column]):
                continue
            following = (row, column)
            spent = best[cell] + length * float(cost[following])
            if spent < best.get(following, math.inf):
                best[following] = spent
                came[following] = cell
                heapq.heappush(waiting, (spent + math.hypot(goal[0] - row, goal[1] - column), following))
    return None


_AROUND = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]])
_CROWDED = 5
_LEAST_TURN = 0.3
AboveZero = Annotated[float, Field(gt=0, le=100)]
Share = Annotated[float, Field(ge=0, le=1)]


class Surprise(StrictModel):
    """Posts that are put onto the way."""

    count: tuple[int, int] = Field(description="fewest and most")
    radius: tuple[AboveZero, AboveZero] = Field(description="least and largest [m]")
    offset: AboveZero = Field(description="from the way to either side at most [m]")
    around: AboveZero = Field(description="within this distance of the way there is another one [m]")


class Drawing(StrictModel):
    """Settings of drawn worlds; units in `drawn_world.yaml`."""

    length: AboveZero
    width: AboveZero
    cell: AboveZero
    post_radius: AboveZero
    fill: tuple[Share, Share]
    rounds: Annotated[int, Field(ge=0, le=20)]
    apron: AboveZero
    disc_radius: AboveZero
    spare: AboveZero
    comfort: AboveZero
    resolution: AboveZero
    spacing: AboveZero
    speed: AboveZero
    slack: AboveZero
    attempts: Annotated[int, Field(ge=1)]
    surprise: Surprise


@cache
def drawing() -> Drawing:
    """Load the shipped settings."""
    return load_checked(Drawing, Path(__file__).parent / "drawn_world.yaml")


@lru_cache(maxsize=64)
def drawn_world(seed: int, *, through: bool = False) -> World:
    """Draw the world of a seed, the same bit for bit at each call.

    Parameters
    ----------
    seed
        Not negative.
    through
        Whether posts are put onto the planned way.

    Raises
    ------
    models.checked_yaml.ConfigError
        If no world with a way was found in the number of attempts that the settings allow.
    """
    settings = drawing()
    random = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(3_002,)))
    fill = float(random.uniform(*settings.fill))
    for _ in range(settings.attempts):
        posts = _field(settings, fill, random)
        world = _plan(settings, posts)
        if world is None:
            continue
        planned, points = world
        if through:
            surprises = _surprises(settings, posts, points, planned, random)
            if surprises is None:
                continue
            posts = np.vstack([posts, surprises])
        length = float(np.hypot(*np.diff(points, axis=0).T).sum())
        return World(
            description=f"field of {len(posts)} posts, {100 * fill:.0f} % of the cells drawn, "
            + ("posts on the planned way" if through else "the planned way is free"),
            way=Way(waypoints=tuple((float(x), float(y)) for x, y in points), speed=settings.speed),
            time_limit=round(settings.slack * length / settings.speed + 8.0, 1),
            posts=tuple(Post(at=(float(x), float(y)), radius=float(r)) for x, y, r in posts),
        )
    raise ConfigError(f"drawn:{seed}: no way in {settings.attempts} attempts; take another seed")


def _field(settings: Drawing, fill: float, random: np.random.Generator) -> FloatArray:
    """Draw posts (n, 3) x, y, radius [m]: the field begins behind the apron and is centred on y = 0."""
    rows, columns = round(settings.width / settings.cell), round(settings.length / settings.cell)
    full = random.random((rows, columns)) < fill
    for _ in range(settings.rounds):
        around = convolve(full.astype(int), _AROUND, mode="constant")
        lonely = (around == 0) & (random.random(full.shape) < 0.5)
        full = (full & ~lonely) | (around >= _CROWDED)
    row, column = np.nonzero(full)
    # Off the raster a little: rows of posts in line are no field.
    shift = random.uniform(-0.25, 0.25, (2, len(row))) * settings.cell
    x = settings.apron + (column + 0.5) * settings.cell + shift[0]
    y = (row + 0.5) * settings.cell - settings.width / 2 + shift[1]
    return np.column_stack([x, y, np.full(len(row), settings.post_radius)])


def _shapes(posts: FloatArray) -> Shapes:
    return Shapes((), posts)


def _map(settings: Drawing, posts: FloatArray) -> ObstacleDistanceGrid:
    # Half a metre beside the field is free, so that a way around it exists.
    low = np.array([-0.3, -settings.width / 2 - 0.0])
    return ObstacleDistanceGrid.build(
        _shapes(posts),
        low,
        np.array([settings.length + 2 * settings.apron + 0.3, settings.width / 2]),
        settings.resolution,
    )


def _ends(settings: Drawing) -> tuple[FloatArray, FloatArray]:
    return np.zeros(2), np.array([settings.length + 2 * settings.apron, 0.0])


def _plan(settings: Drawing, posts: FloatArray) -> tuple[ObstacleDistanceGrid, FloatArray] | None:
    """Plan the map and waypoints (k, 2) of a smooth path for the disc around the robot; None without one."""
    grid = _map(settings, posts)
    way = grid.way(*_ends(settings), settings.disc_radius + settings.spare, comfort=settings.comfort)
    if way is None:
        return None
    points = _waypoints(way, settings.spacing)
    dense, bend = _smooth(points)
    if _shapes(posts).distance(dense).min() < settings.disc_radius + 0.5 * settings.spare or bend * _LEAST_TURN > 1:
        return None
    return grid, points


def _waypoints(way: FloatArray, spacing: float) -> FloatArray:
    """Sample an A* path at about even spacing, with corners rounded by a moving mean."""
    window = 9
    padded = np.vstack([np.repeat(way[:1], window // 2, axis=0), way, np.repeat(way[-1:], window // 2, axis=0)])
    kernel = np.ones(window) / window
    rounded = np.column_stack([np.convolve(padded[:, i], kernel, mode="valid") for i in (0, 1)])
    rounded[0], rounded[-1] = way[0], way[-1]
    arc = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(rounded, axis=0).T))])
    arc_lengths = np.linspace(0.0, arc[-1], max(2, round(arc[-1] / spacing) + 1))
    return np.column_stack([np.interp(arc_lengths, arc, rounded[:, i]) for i in (0, 1)])


def _smooth(points: FloatArray) -> tuple[FloatArray, float]:
    """Compute points (n, 2) of the cubic spline of a reference through waypoints, and its maximum curvature [1/m]."""
    chord = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
    spline = CubicSpline(chord, points, bc_type="natural")
    parameters = np.linspace(0.0, chord[-1], max(2, round(chord[-1] / 0.02)))
    first, second = spline(parameters, 1), spline(parameters, 2)
    bend = np.abs(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]) / np.hypot(*first.T) ** 3
    return spline(parameters), float(bend.max())


def _surprises(
    settings: Drawing, posts: FloatArray, points: FloatArray, planned: ObstacleDistanceGrid, random: np.random.Generator
) -> FloatArray | None:
    """Draw posts (n, 3) on the path with another path around them; None without success."""
    dense, _ = _smooth(points)
    corridor: NDArray[np.bool_] = near(planned, dense, settings.surprise.around)
    inside = np.flatnonzero(
        (dense[:, 0] > settings.apron + 0.5) & (dense[:, 0] < settings.length + settings.apron - 0.5)
    )
    for _ in range(20):
        count = int(random.integers(settings.surprise.count[0], settings.surprise.count[1] + 1))
        indices = random.choice(inside, count, replace=False)
        tangent = np.gradient(dense, axis=0)[indices]
        tangent /= np.hypot(*tangent.T)[:, None]
        offset = random.uniform(-settings.surprise.offset, settings.surprise.offset, count)
        middle = dense[indices] + offset[:, None] * np.column_stack([-tangent[:, 1], tangent[:, 0]])
        placed = np.column_stack([middle, random.uniform(*settings.surprise.radius, count)])
        grid = _map(settings, np.vstack([posts, placed]))
        if grid.way(*_ends(settings), settings.disc_radius + settings.spare, only=corridor) is not None:
            return placed
    return None
