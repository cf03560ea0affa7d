"""Worlds that a seed draws: fields of posts of graded density with a way through them that a planner has found.

The idea is that of the BARN benchmark: D. Perille, A. Truong, X. Xiao, P. Stone, "Benchmarking metric ground
navigation", SSRR 2020. A cellular automaton clusters a random field; what has no way for the disc around the robot is
drawn again. In `drawn:SEED` the smooth path is free and may pass near obstacles. In `drawn:SEED:through` posts have
been put onto that path afterwards, as after the planner has looked: there is a way around them that stays near.
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
    def of(cls, shapes: Shapes, low: FloatArray, high: FloatArray, resolution: float) -> ObstacleDistanceGrid:
        """Of a rectangle from `low` to `high` (2,) [m]; exact at the middles of the cells."""
        columns, rows = (np.ceil((high - low) / resolution).astype(int) + 1).tolist()
        x, y = low[0] + resolution * np.arange(columns), low[1] + resolution * np.arange(rows)
        points = np.column_stack([one.ravel() for one in np.meshgrid(x, y)])
        return cls(np.asarray(low, dtype=float), resolution, shapes.distance(points).reshape(rows, columns))

    def cell(self, point: FloatArray) -> tuple[int, int]:
        """Row and column of the nearest cell."""
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
        """The best way (n, 2) [m] for a disc of `radius` [m], or None where there is none.

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


def near(of: ObstacleDistanceGrid, way: FloatArray, distance: float) -> NDArray[np.bool_]:
    """(rows, columns) cells within `distance` [m] of the points of a way."""
    away = np.ones(of.clearance.shape, dtype=bool)
    for point in way:
        away[of.cell(point)] = False
    return np.asarray(distance_transform_edt(away) * of.resolution <= distance)


def _astar(
    free: NDArray[np.bool_], cost: FloatArray, start: tuple[int, int], goal: tuple[int, int]
) -> list[tuple[int, int]] | None:
    """Cells from start to goal over eight neighbours, or None."""
    if not (free[start] and free[goal]):
        return None
    rows, columns = free.shape
    best = {start: 0.0}
    came: dict[tuple[int, int], tuple[int, int]] = {}
    done: set[tuple[int, int]] = set()
    waiting = [(0.0, start)]
    while waiting:
        _, here = heapq.heappop(waiting)
        if here == goal:
            cells = [here]
            while here in came:
                here = came[here]
                cells.append(here)
            return cells[::-1]
        if here in done:
            continue
        done.add(here)
        for i, j, length in _STEPS:
            row, column = here[0] + i, here[1] + j
            if not (0 <= row < rows and 0 <= column < columns and free[row, column]):
                continue
            there = (row, column)
            spent = best[here] + length * float(cost[there])
            if spent < best.get(there, math.inf):
                best[there] = spent
                came[there] = here
                heapq.heappush(waiting, (spent + math.hypot(goal[0] - row, goal[1] - column), there))
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
    """What drawn worlds are made of; units in `drawn_world.yaml`."""

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
    """The shipped settings."""
    return load_checked(Drawing, Path(__file__).parent / "drawn_world.yaml")


@lru_cache(maxsize=64)
def drawn_world(seed: int, *, through: bool = False) -> World:
    """The world of a seed, the same bit for bit at each call.

    Parameters
    ----------
    seed
        Not negative.
    through
        Whether posts are put onto the way that was planned.

    Raises
    ------
    models.checked_yaml.ConfigError
        If no world with a way was found in the number of attempts that the settings allow.
    """
    of = drawing()
    random = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(3_002,)))
    fill = float(random.uniform(*of.fill))
    for _ in range(of.attempts):
        posts = _field(of, fill, random)
        world = _plan(of, posts)
        if world is None:
            continue
        planned, points = world
        if through:
            surprises = _surprises(of, posts, points, planned, random)
            if surprises is None:
                continue
            posts = np.vstack([posts, surprises])
        length = float(np.hypot(*np.diff(points, axis=0).T).sum())
        return World(
            description=f"field of {len(posts)} posts, {100 * fill:.0f} % of the cells drawn, "
            + ("posts on the planned way" if through else "the planned way is free"),
            way=Way(waypoints=tuple((float(x), float(y)) for x, y in points), speed=of.speed),
            time_limit=round(of.slack * length / of.speed + 8.0, 1),
            posts=tuple(Post(at=(float(x), float(y)), radius=float(r)) for x, y, r in posts),
        )
    raise ConfigError(f"drawn:{seed}: no way in {of.attempts} attempts; take another seed")


def _field(of: Drawing, fill: float, random: np.random.Generator) -> FloatArray:
    """(n, 3) posts x, y, radius [m]: the field begins behind the apron and is centred on y = 0."""
    rows, columns = round(of.width / of.cell), round(of.length / of.cell)
    full = random.random((rows, columns)) < fill
    for _ in range(of.rounds):
        around = convolve(full.astype(int), _AROUND, mode="constant")
        lonely = (around == 0) & (random.random(full.shape) < 0.5)
        full = (full & ~lonely) | (around >= _CROWDED)
    row, column = np.nonzero(full)
    # Off the raster a little: rows of posts in line are no field.
    shift = random.uniform(-0.25, 0.25, (2, len(row))) * of.cell
    x = of.apron + (column + 0.5) * of.cell + shift[0]
    y = (row + 0.5) * of.cell - of.width / 2 + shift[1]
    return np.column_stack([x, y, np.full(len(row), of.post_radius)])


def _shapes(posts: FloatArray) -> Shapes:
    return Shapes((), posts)


def _map(of: Drawing, posts: FloatArray) -> ObstacleDistanceGrid:
    # Half a metre beside the field is free, so that the way round it is one, too.
    low = np.array([-0.3, -of.width / 2 - 0.0])
    return ObstacleDistanceGrid.of(
        _shapes(posts), low, np.array([of.length + 2 * of.apron + 0.3, of.width / 2]), of.resolution
    )


def _ends(of: Drawing) -> tuple[FloatArray, FloatArray]:
    return np.zeros(2), np.array([of.length + 2 * of.apron, 0.0])


def _plan(of: Drawing, posts: FloatArray) -> tuple[ObstacleDistanceGrid, FloatArray] | None:
    """The map and waypoints (k, 2) of a smooth path that the disc around the robot can follow; None without one."""
    grid = _map(of, posts)
    way = grid.way(*_ends(of), of.disc_radius + of.spare, comfort=of.comfort)
    if way is None:
        return None
    points = _waypoints(way, of.spacing)
    dense, bend = _smooth(points)
    if _shapes(posts).distance(dense).min() < of.disc_radius + 0.5 * of.spare or bend * _LEAST_TURN > 1:
        return None
    return grid, points


def _waypoints(way: FloatArray, spacing: float) -> FloatArray:
    """Points of an A* way at about equal distances, corners rounded by a moving mean."""
    window = 9
    padded = np.vstack([np.repeat(way[:1], window // 2, axis=0), way, np.repeat(way[-1:], window // 2, axis=0)])
    kernel = np.ones(window) / window
    rounded = np.column_stack([np.convolve(padded[:, i], kernel, mode="valid") for i in (0, 1)])
    rounded[0], rounded[-1] = way[0], way[-1]
    arc = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(rounded, axis=0).T))])
    at = np.linspace(0.0, arc[-1], max(2, round(arc[-1] / spacing) + 1))
    return np.column_stack([np.interp(at, arc, rounded[:, i]) for i in (0, 1)])


def _smooth(points: FloatArray) -> tuple[FloatArray, float]:
    """Points (n, 2) of the cubic spline that a reference lays through waypoints, and its largest curvature [1/m]."""
    chord = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
    spline = CubicSpline(chord, points, bc_type="natural")
    at = np.linspace(0.0, chord[-1], max(2, round(chord[-1] / 0.02)))
    first, second = spline(at, 1), spline(at, 2)
    bend = np.abs(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]) / np.hypot(*first.T) ** 3
    return spline(at), float(bend.max())


def _surprises(
    of: Drawing, posts: FloatArray, points: FloatArray, planned: ObstacleDistanceGrid, random: np.random.Generator
) -> FloatArray | None:
    """(n, 3) posts on the way, around which there is another one; None where none was found."""
    dense, _ = _smooth(points)
    corridor: NDArray[np.bool_] = near(planned, dense, of.surprise.around)
    inside = np.flatnonzero((dense[:, 0] > of.apron + 0.5) & (dense[:, 0] < of.length + of.apron - 0.5))
    for _ in range(20):
        count = int(random.integers(of.surprise.count[0], of.surprise.count[1] + 1))
        at = random.choice(inside, count, replace=False)
        tangent = np.gradient(dense, axis=0)[at]
        tangent /= np.hypot(*tangent.T)[:, None]
        offset = random.uniform(-of.surprise.offset, of.surprise.offset, count)
        middle = dense[at] + offset[:, None] * np.column_stack([-tangent[:, 1], tangent[:, 0]])
        placed = np.column_stack([middle, random.uniform(*of.surprise.radius, count)])
        grid = _map(of, np.vstack([posts, placed]))
        if grid.way(*_ends(of), of.disc_radius + of.spare, only=corridor) is not None:
            return placed
    return None
