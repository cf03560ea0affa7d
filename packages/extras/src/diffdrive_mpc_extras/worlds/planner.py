"""Whether there is a way for a disc through obstacles, and the shortest one: A* on an inflated grid."""

from __future__ import annotations

import heapq
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc_extras.worlds.shapes import Shapes

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
