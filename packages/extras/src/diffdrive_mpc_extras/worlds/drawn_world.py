"""Random worlds: fields of posts with a random density and a planned path through them.

The method follows the BARN benchmark: D. Perille, A. Truong, X. Xiao, P. Stone, "Benchmarking metric ground
navigation", SSRR 2020. A cellular automaton clusters a random field. A world without a path for the disc around the
robot is drawn again. In `drawn:SEED` the smooth path is free but may pass near obstacles. In `drawn:SEED:through` posts
are placed on the planned path afterwards, like obstacles that appear after planning; a detour near the path exists.
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
from diffdrive_mpc_extras.worlds.world import DrivePath, World

_NEIGHBOURS = tuple((i, j, math.hypot(i, j)) for i in (-1, 0, 1) for j in (-1, 0, 1) if (i, j) != (0, 0))


@dataclass(frozen=True, eq=False)
class ObstacleDistanceGrid:
    """Grid of distances from the nearest obstacle.

    Attributes
    ----------
    origin
        (2,) x, y of the centre of the first cell [m].
    resolution
        Side of a cell [m].
    clearance
        (rows, columns) distance of each cell centre from the nearest obstacle [m], rows along y.
    """

    origin: FloatArray
    resolution: float
    clearance: FloatArray

    @classmethod
    def build(cls, shapes: Shapes, low: FloatArray, high: FloatArray, resolution: float) -> ObstacleDistanceGrid:
        """Build the grid of a rectangle from `low` to `high` (2,) [m]; distances are exact at the cell centres."""
        columns, rows = (np.ceil((high - low) / resolution).astype(int) + 1).tolist()
        x, y = low[0] + resolution * np.arange(columns), low[1] + resolution * np.arange(rows)
        points = np.column_stack([axis.ravel() for axis in np.meshgrid(x, y)])
        return cls(np.asarray(low, dtype=float), resolution, shapes.distance(points).reshape(rows, columns))

    def cell(self, point: FloatArray) -> tuple[int, int]:
        """Return row and column of the nearest cell."""
        column, row = np.rint((np.asarray(point) - self.origin) / self.resolution).astype(int).tolist()
        rows, columns = self.clearance.shape
        return min(max(row, 0), rows - 1), min(max(column, 0), columns - 1)

    def shortest_path(
        self,
        start: FloatArray,
        goal: FloatArray,
        radius: float,
        *,
        comfort: float = 0.0,
        allowed: NDArray[np.bool_] | None = None,
    ) -> FloatArray | None:
        """Find the path (n, 2) [m] of minimum cost for a disc of `radius` [m]; None if there is no path.

        Parameters
        ----------
        start, goal
            (2,) x, y [m].
        radius
            Cells nearer than this to an obstacle are forbidden [m].
        comfort
            Additional clearance below which the cost of a cell rises linearly, up to double [m].
        allowed
            (rows, columns) mask of usable cells; None for all.
        """
        free = self.clearance > radius
        if allowed is not None:
            free = free & allowed
        cost = np.ones_like(self.clearance)
        if comfort > 0:
            cost += np.clip(1.0 - (self.clearance - radius) / comfort, 0.0, 1.0)
        cells = _astar(free, cost, self.cell(start), self.cell(goal))
        if cells is None:
            return None
        return self.origin + self.resolution * np.array(cells, dtype=float)[:, ::-1]


def path_corridor(grid: ObstacleDistanceGrid, path: FloatArray, distance: float) -> NDArray[np.bool_]:
    """Mark the cells (rows, columns) within `distance` [m] of the points (n, 2) of a path [m]."""
    off_path = np.ones(grid.clearance.shape, dtype=bool)
    for point in path:
        off_path[grid.cell(point)] = False
    return np.asarray(distance_transform_edt(off_path) * grid.resolution <= distance)


def _astar(
    free: NDArray[np.bool_], cost: FloatArray, start: tuple[int, int], goal: tuple[int, int]
) -> list[tuple[int, int]] | None:
    """Search the cheapest list of cells from start to goal over eight neighbours (A*); None if there is no path."""
    if not (free[start] and free[goal]):
        return None
    rows, columns = free.shape
    cost_to_cell = {start: 0.0}
    parents: dict[tuple[int, int], tuple[int, int]] = {}
    closed: set[tuple[int, int]] = set()
    queue = [(0.0, start)]
    while queue:
        _, cell = heapq.heappop(queue)
        if cell == goal:
            cells = [cell]
            while cell in parents:
                cell = parents[cell]
                cells.append(cell)
            return cells[::-1]
        if cell in closed:
            continue
        closed.add(cell)
        for i, j, length in _NEIGHBOURS:
            row, column = cell[0] + i, cell[1] + j
            if not (0 <= row < rows and 0 <= column < columns and free[row, column]):
                continue
            neighbour = (row, column)
            new_cost = cost_to_cell[cell] + length * float(cost[neighbour])
            if new_cost < cost_to_cell.get(neighbour, math.inf):
                cost_to_cell[neighbour] = new_cost
                parents[neighbour] = cell
                heapq.heappush(queue, (new_cost + math.hypot(goal[0] - row, goal[1] - column), neighbour))
    return None


_NEIGHBOUR_KERNEL = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]])
_FILL_COUNT = 5
"""Number of filled neighbours from which the cellular automaton fills a cell."""
_MIN_TURN_RADIUS = 0.3
"""Minimum radius of curvature of the smooth path [m]."""
AboveZero = Annotated[float, Field(gt=0, le=100)]
Share = Annotated[float, Field(ge=0, le=1)]


class SurprisePosts(StrictModel):
    """Settings of posts that are placed on the planned path."""

    count: tuple[int, int] = Field(description="minimum and maximum number of posts")
    radius: tuple[AboveZero, AboveZero] = Field(description="minimum and maximum radius [m]")
    offset: AboveZero = Field(description="maximum lateral distance of a post from the path [m]")
    around: AboveZero = Field(description="distance from the path within which a detour exists [m]")


class FieldSettings(StrictModel):
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
    surprise: SurprisePosts


@cache
def drawn_world_settings() -> FieldSettings:
    """Load the shipped settings."""
    return load_checked(FieldSettings, Path(__file__).parent / "drawn_world.yaml")


@lru_cache(maxsize=64)
def drawn_world(seed: int, *, through: bool = False) -> World:
    """Draw the world of a seed; equal seeds give identical worlds.

    Parameters
    ----------
    seed
        Seed, not negative.
    through
        Whether posts are placed on the planned path.

    Raises
    ------
    models.checked_yaml.ConfigError
        If no attempt, up to the number in the settings, gives a world with a path.
    """
    settings = drawn_world_settings()
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(3_002,)))
    fill = float(rng.uniform(*settings.fill))
    for _ in range(settings.attempts):
        posts = _draw_posts(settings, fill, rng)
        plan = _plan(settings, posts)
        if plan is None:
            continue
        grid, points = plan
        if through:
            surprises = _draw_surprises(settings, posts, points, grid, rng)
            if surprises is None:
                continue
            posts = np.vstack([posts, surprises])
        length = float(np.hypot(*np.diff(points, axis=0).T).sum())
        return World(
            description=f"field of {len(posts)} posts, {100 * fill:.0f} % of the cells drawn, "
            + ("posts on the planned path" if through else "the planned path is free"),
            way=DrivePath(waypoints=tuple((float(x), float(y)) for x, y in points), speed=settings.speed),
            time_limit=round(settings.slack * length / settings.speed + 8.0, 1),
            posts=tuple(Post(at=(float(x), float(y)), radius=float(r)) for x, y, r in posts),
        )
    raise ConfigError(f"drawn:{seed}: no path found in {settings.attempts} attempts; use another seed")


def _draw_posts(settings: FieldSettings, fill: float, rng: np.random.Generator) -> FloatArray:
    """Draw posts (n, 3) x, y, radius [m]; the field starts behind the apron and is centred on y = 0."""
    rows, columns = round(settings.width / settings.cell), round(settings.length / settings.cell)
    full = rng.random((rows, columns)) < fill
    for _ in range(settings.rounds):
        neighbours = convolve(full.astype(int), _NEIGHBOUR_KERNEL, mode="constant")
        removed = (neighbours == 0) & (rng.random(full.shape) < 0.5)
        full = (full & ~removed) | (neighbours >= _FILL_COUNT)
    row, column = np.nonzero(full)
    # A random offset from the raster avoids aligned rows of posts.
    shift = rng.uniform(-0.25, 0.25, (2, len(row))) * settings.cell
    x = settings.apron + (column + 0.5) * settings.cell + shift[0]
    y = (row + 0.5) * settings.cell - settings.width / 2 + shift[1]
    return np.column_stack([x, y, np.full(len(row), settings.post_radius)])


def _shapes(posts: FloatArray) -> Shapes:
    return Shapes((), posts)


def _distance_grid(settings: FieldSettings, posts: FloatArray) -> ObstacleDistanceGrid:
    low = np.array([-0.3, -settings.width / 2 - 0.0])
    return ObstacleDistanceGrid.build(
        _shapes(posts),
        low,
        np.array([settings.length + 2 * settings.apron + 0.3, settings.width / 2]),
        settings.resolution,
    )


def _ends(settings: FieldSettings) -> tuple[FloatArray, FloatArray]:
    """Return start and goal (2,) of the path [m]."""
    return np.zeros(2), np.array([settings.length + 2 * settings.apron, 0.0])


def _plan(settings: FieldSettings, posts: FloatArray) -> tuple[ObstacleDistanceGrid, FloatArray] | None:
    """Plan a smooth path for the disc around the robot; return grid and waypoints (k, 2) [m], or None on failure."""
    grid = _distance_grid(settings, posts)
    path = grid.shortest_path(*_ends(settings), settings.disc_radius + settings.spare, comfort=settings.comfort)
    if path is None:
        return None
    points = _waypoints(path, settings.spacing)
    dense, curvature = _smooth(points)
    min_clearance = settings.disc_radius + 0.5 * settings.spare
    if _shapes(posts).distance(dense).min() < min_clearance or curvature * _MIN_TURN_RADIUS > 1:
        return None
    return grid, points


def _waypoints(path: FloatArray, spacing: float) -> FloatArray:
    """Sample an A* path at about even spacing [m], with corners rounded by a moving average."""
    window = 9
    padded = np.vstack([np.repeat(path[:1], window // 2, axis=0), path, np.repeat(path[-1:], window // 2, axis=0)])
    kernel = np.ones(window) / window
    rounded = np.column_stack([np.convolve(padded[:, i], kernel, mode="valid") for i in (0, 1)])
    rounded[0], rounded[-1] = path[0], path[-1]
    arc = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(rounded, axis=0).T))])
    arc_lengths = np.linspace(0.0, arc[-1], max(2, round(arc[-1] / spacing) + 1))
    return np.column_stack([np.interp(arc_lengths, arc, rounded[:, i]) for i in (0, 1)])


def _smooth(points: FloatArray) -> tuple[FloatArray, float]:
    """Compute points (n, 2) of the cubic spline through waypoints [m], and its maximum curvature [1/m]."""
    chord = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
    spline = CubicSpline(chord, points, bc_type="natural")
    parameters = np.linspace(0.0, chord[-1], max(2, round(chord[-1] / 0.02)))
    first, second = spline(parameters, 1), spline(parameters, 2)
    curvature = np.abs(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]) / np.hypot(*first.T) ** 3
    return spline(parameters), float(curvature.max())


def _draw_surprises(
    settings: FieldSettings, posts: FloatArray, points: FloatArray, grid: ObstacleDistanceGrid, rng: np.random.Generator
) -> FloatArray | None:
    """Draw posts (n, 3) x, y, radius [m] on the path that leave a detour near it; None if all attempts fail."""
    dense, _ = _smooth(points)
    corridor: NDArray[np.bool_] = path_corridor(grid, dense, settings.surprise.around)
    inside = np.flatnonzero(
        (dense[:, 0] > settings.apron + 0.5) & (dense[:, 0] < settings.length + settings.apron - 0.5)
    )
    for _ in range(20):
        count = int(rng.integers(settings.surprise.count[0], settings.surprise.count[1] + 1))
        indices = rng.choice(inside, count, replace=False)
        tangent = np.gradient(dense, axis=0)[indices]
        tangent /= np.hypot(*tangent.T)[:, None]
        offset = rng.uniform(-settings.surprise.offset, settings.surprise.offset, count)
        centre = dense[indices] + offset[:, None] * np.column_stack([-tangent[:, 1], tangent[:, 0]])
        surprises = np.column_stack([centre, rng.uniform(*settings.surprise.radius, count)])
        blocked = _distance_grid(settings, np.vstack([posts, surprises]))
        if blocked.shortest_path(*_ends(settings), settings.disc_radius + settings.spare, allowed=corridor) is not None:
            return surprises
    return None
