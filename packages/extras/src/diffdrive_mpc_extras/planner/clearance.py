"""Clearance of the robot: exact distances, a map for the search, and the checks of a request."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc_extras.free_space import Footprint, Surroundings
from diffdrive_mpc_extras.free_space.polygons import convex_pieces
from diffdrive_mpc_extras.free_space.surroundings import check_disc, checked_polygon
from diffdrive_mpc_extras.planner.inputs import OBJECTIVES, sharpest_radius
from diffdrive_mpc_extras.planner.settings import PlanSettings
from diffdrive_mpc_extras.turn_costs import TurnCosts
from diffdrive_mpc_extras.turn_costs.vehicle import Vehicle

# Largest ratio of a way over eight neighbours to the straight one.
_GRID_DETOUR = 1.0824


def outline(vehicle: Vehicle) -> Footprint:
    """Return the rectangle that contains the wheels and tyres."""
    return Footprint.rectangle(
        vehicle.wheel_base + 2 * vehicle.wheel_radius, vehicle.track + vehicle.patch_width, ahead=0.0
    )


def covering_discs(footprint: Footprint) -> FloatArray:
    """Cover a footprint by equal discs (k, 3) x, y, radius [m] in a row along the longer side."""
    low, high = footprint.corners.min(axis=0), footprint.corners.max(axis=0)
    size, middle = high - low, 0.5 * (low + high)
    axis = int(size[1] > size[0])
    wide = max(float(size[1 - axis]), 1e-9)
    count = min(6, max(1, math.ceil(float(size[axis]) / wide)))
    part = float(size[axis]) / count
    centres = np.tile(middle, (count, 1))
    centres[:, axis] = low[axis] + part * (np.arange(count) + 0.5)
    return np.column_stack([centres, np.full(count, math.hypot(part, size[1 - axis]) / 2 + footprint.radius)])


class Clearance:
    """Distances of the robot from discs and convex polygons.

    Parameters
    ----------
    surroundings
        Polygons and discs; moving discs are used at their present position.
    footprint
        Footprint of the robot.

    Raises
    ------
    mpc.free_space.SurroundingsError
        If an obstacle is invalid.
    """

    def __init__(self, surroundings: Surroundings, footprint: Footprint) -> None:
        polygons = [checked_polygon(polygon, f"polygon {i}") for i, polygon in enumerate(surroundings.polygons)]
        self._polygons = [piece for polygon in polygons for piece in convex_pieces(polygon)]
        for i, disc in enumerate(surroundings.discs):
            check_disc(disc, f"disc {i}", timed=True)
        self._discs = np.array([(disc.x, disc.y, disc.radius) for disc in surroundings.discs]).reshape(-1, 3)
        self.robot = covering_discs(footprint)

    @property
    def empty(self) -> bool:
        """True if there are no obstacles."""
        return not (len(self._discs) or self._polygons)

    @property
    def corners(self) -> FloatArray:
        """(k, 2) corners of all obstacles and their bounding boxes [m]."""
        reach = self._discs[:, 2:]
        parts = [*self._polygons, self._discs[:, :2] - reach, self._discs[:, :2] + reach]
        return np.concatenate(parts)

    def nearest(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Compute signed distances (n, k) [m] of points (n, 2) from obstacles, and unit vectors (n, k, 2) away."""
        gaps, normals = [], []
        for x, y, radius in self._discs:
            gap = points - (x, y)
            far = np.hypot(*gap.T)
            gaps.append(far - radius)
            normals.append(gap / np.maximum(far, 1e-12)[:, None])
        for corners in self._polygons:
            gap, unit = _polygon_distance(points, corners)
            gaps.append(gap)
            normals.append(unit)
        return np.stack(gaps, axis=1), np.stack(normals, axis=1)

    def centres(self, poses: FloatArray) -> FloatArray:
        """Compute centres (..., k, 2) of the robot's discs at poses (..., 3) [m]."""
        c, s = np.cos(poses[..., 2, None]), np.sin(poses[..., 2, None])
        x, y = self.robot[:, 0], self.robot[:, 1]
        return np.stack([poses[..., 0, None] + c * x - s * y, poses[..., 1, None] + s * x + c * y], axis=-1)

    def of_poses(self, poses: FloatArray) -> FloatArray:
        """Compute the clearance (n,) of the robot at poses (n, 3) [m]; negative for an overlap."""
        if self.empty:
            return np.full(len(poses), np.inf)
        points = self.centres(poses)
        gaps, _ = self.nearest(points.reshape(-1, 2))
        return np.asarray((gaps.min(axis=1).reshape(points.shape[:2]) - self.robot[:, 2]).min(axis=1))


class ClearanceMap:
    """Conservative clearance over a rectangle, by the nearest cell.

    Parameters
    ----------
    clearance
        Exact distances.
    points
        (n, 2) points that must be inside the map.
    room, cell
        Margin of the map around points and obstacles, and edge length of its cells [m].
    """

    def __init__(self, clearance: Clearance, points: FloatArray, room: float, cell: float) -> None:
        extent = np.concatenate([points, clearance.corners])
        low, high = extent.min(axis=0) - room, extent.max(axis=0) + room
        self._low, self._cell = low, max(cell, float((high - low).max()) / 800)
        columns, rows = (np.ceil((high - low) / self._cell).astype(int) + 1).tolist()
        x, y = low[0] + self._cell * np.arange(columns), low[1] + self._cell * np.arange(rows)
        grid = np.stack(np.meshgrid(x, y), axis=-1)
        gaps = np.concatenate([clearance.nearest(row)[0].min(axis=1)[None] for row in grid])
        # The distance of a point from the centre of its cell is at most half a diagonal.
        self._gaps = gaps - math.sqrt(0.5) * self._cell
        self._clearance = clearance

    def free(self, poses: FloatArray, margin: float) -> NDArray[np.bool_]:
        """Return (...) True if the robot at poses (..., 3) is on the map and has a clearance of `margin` [m]."""
        cells = np.rint((self._clearance.centres(poses) - self._low) / self._cell).astype(int)
        rows, columns = self._gaps.shape
        column, row = cells[..., 0], cells[..., 1]
        inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
        gaps = self._gaps[np.clip(row, 0, rows - 1), np.clip(column, 0, columns - 1)]
        return np.asarray((inside & (gaps - self._clearance.robot[:, 2] >= margin)).all(axis=-1))

    def distances(self, target: Sequence[float], margin: float) -> PathLowerBound:
        """Return a lower bound of the path length to a point around all obstacles, for a disc of the robot's width."""
        stride = max(1, round(0.15 / self._cell))
        gaps = self._gaps[::stride, ::stride]
        # Narrow gaps count as passable, because the bound must not overestimate the distance.
        slack = (1 + math.sqrt(0.5)) * stride * self._cell
        return PathLowerBound(
            gaps + slack > self._clearance.robot[0, 2] + margin, self._low, stride * self._cell, target
        )


class PathLowerBound:
    """Lower bound of the path length to a point over free cells."""

    def __init__(self, free: NDArray[np.bool_], low: FloatArray, cell: float, target: Sequence[float]) -> None:
        self._low, self._cell, self._shape = low, cell, free.shape
        index = np.arange(free.size).reshape(free.shape)
        starts, ends, lengths = [], [], []
        for i, j in ((0, 1), (1, 0), (1, 1), (1, -1)):
            a = index[: free.shape[0] - i, max(0, -j) : free.shape[1] - max(0, j)]
            b = index[i:, max(0, j) : free.shape[1] - max(0, -j)]
            both = free.ravel()[a] & free.ravel()[b]
            starts.append(a[both])
            ends.append(b[both])
            lengths.append(np.full(int(both.sum()), cell * math.hypot(i, j)))
        graph = coo_matrix(
            (np.concatenate(lengths), (np.concatenate(starts), np.concatenate(ends))), shape=(free.size, free.size)
        )
        row, column = self._cells(np.asarray(target, dtype=float)[None, :2])
        self._far = dijkstra(graph.tocsr(), directed=False, indices=int(index[row[0], column[0]]))

    def __call__(self, points: FloatArray) -> FloatArray:
        """Return lengths (n,) [m] for points (n, 2); infinity without a path."""
        row, column = self._cells(points)
        pieces = self._far[row * self._shape[1] + column]
        return np.asarray(np.maximum(pieces / _GRID_DETOUR - 1.5 * self._cell, 0.0))

    def _cells(self, points: FloatArray) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        cells = np.rint((points - self._low) / self._cell).astype(int)
        return np.clip(cells[:, 1], 0, self._shape[0] - 1), np.clip(cells[:, 0], 0, self._shape[1] - 1)


def _polygon_distance(points: FloatArray, corners: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Compute the signed distance (n,) of points (n, 2) from a convex polygon, and the outward direction (n, 2)."""
    edges = np.roll(corners, -1, axis=0) - corners
    lengths = np.hypot(*edges.T)
    outward = np.stack([edges[:, 1], -edges[:, 0]], -1) / lengths[:, None]
    gaps = points[:, None] - corners
    beyond = (gaps * outward).sum(-1)
    fraction = np.clip((gaps * edges).sum(-1) / lengths**2, 0.0, 1.0)
    offset = gaps - fraction[..., None] * edges
    far = np.hypot(offset[..., 0], offset[..., 1])
    nearest, deepest = far.argmin(axis=1), beyond.argmax(axis=1)
    rows = np.arange(len(points))
    inside = beyond.max(axis=1) <= 0
    gap = np.where(inside, beyond[rows, deepest], far[rows, nearest])
    unit = offset[rows, nearest] / np.maximum(far[rows, nearest], 1e-12)[:, None]
    return gap, np.where((inside | (gap < 1e-9))[:, None], outward[deepest], unit)


# Checks of a request; each error is one sentence.


_MAX_COORDINATE = 1e4
_MIN_DISTANCE, _MIN_TURN = 1e-3, 1e-3


class PlanError(ConfigError):
    """Error if a plan is impossible. The message is one line: the cause with its values, and the remedy."""


def check_request(
    start: ArrayLike, goal: ArrayLike, via: ArrayLike, minimise: str, speed: float, dt: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Check a request; return start (3,), goal (3,) and via points (n, 2). Raises PlanError for invalid values."""
    if minimise not in OBJECTIVES:
        raise PlanError(f"minimise '{minimise}': give {', '.join(OBJECTIVES[:-1])} or {OBJECTIVES[-1]}")
    if not (math.isfinite(speed) and speed > 0):
        raise PlanError(f"speed {speed} m/s: give a positive number")
    if not (math.isfinite(dt) and dt > 0):
        raise PlanError(f"sample time {dt} s: give a positive number")
    poses = []
    for name, value in (("start", start), ("goal", goal)):
        pose = np.asarray(value, dtype=float)
        if pose.shape != (3,) or not np.isfinite(pose).all() or np.abs(pose).max() > _MAX_COORDINATE:
            raise PlanError(f"{name} {np.ravel(pose).tolist()}: give x, y [m] and theta [rad], finite numbers")
        poses.append(pose)
    points = np.asarray(via, dtype=float).reshape(-1, 2) if np.size(via) % 2 == 0 else np.full((1, 2), np.nan)
    if not np.isfinite(points).all() or (points.size and np.abs(points).max() > _MAX_COORDINATE):
        raise PlanError("via: give x, y [m] of each point, finite numbers")
    start_pose, end = poses
    turn = math.remainder(float(end[2] - start_pose[2]), 2 * math.pi)
    if not len(points) and math.dist(start_pose[:2], end[:2]) < _MIN_DISTANCE and abs(turn) < _MIN_TURN:
        raise PlanError(f"start and goal are the same, {pose_text(start_pose)}: there is nothing to drive")
    stops = np.concatenate([start_pose[None, :2], points, end[None, :2]])
    close = np.hypot(*np.diff(stops, axis=0).T) < _MIN_DISTANCE
    if len(points) and close.any():
        raise PlanError(f"via: point {int(np.argmax(close)) + 1} coincides with the point before it; remove one")
    return start_pose, end, points


def allowed_radius(costs: TurnCosts, speed: float, settings: PlanSettings) -> float:
    """Return the minimum radius [m]; raises PlanError if the robot cannot drive or turn at this speed."""
    if speed > settings.motion.top_speed:
        raise PlanError(
            f"speed {speed:g} m/s exceeds {settings.motion.top_speed:g} m/s (motion.top_speed); lower the speed, or "
            "give settings for a faster robot"
        )
    straight = np.abs(costs.torques([[speed, 0.0]])).max()
    if straight >= costs.vehicle.torque_limit:
        raise PlanError(f"speed {speed:g} m/s: the motor torque is too low for straight motion; lower the speed")
    sharp = sharpest_radius(costs, speed, settings)
    if not math.isfinite(sharp):
        raise PlanError(f"speed {speed:g} m/s: turns need more torque than the motors have; lower the speed")
    return sharp


def build_free_map(
    clearance: Clearance | None, start_pose: FloatArray, end: FloatArray, via: FloatArray, settings: PlanSettings
) -> tuple[ClearanceMap, float] | None:
    """Build the map of the search; raises PlanError if start, goal or a via point is not free."""
    if clearance is None:
        return None
    margin = settings.motion.margin
    for name, pose in (("start", start_pose), ("goal", end)):
        room = float(clearance.of_poses(pose[None])[0])
        if room < margin:
            problem = "overlaps an obstacle" if room < 0 else f"is {room:.2f} m from an obstacle"
            raise PlanError(
                f"{name} {pose_text(pose)}: the robot {problem}; the margin is {margin:g} m; move the {name}, or "
                "use a smaller margin"
            )
    for i, point in enumerate(via):
        headings = np.column_stack([np.tile(point, (16, 1)), np.linspace(-np.pi, np.pi, 16)])
        if (clearance.of_poses(headings) < margin).all():
            raise PlanError(
                f"via {i + 1} ({point[0]:g}, {point[1]:g}): the robot is less than {margin:g} m from an obstacle there "
                "in all headings; move the point, or use a smaller margin"
            )
    points = np.concatenate([start_pose[None, :2], via, end[None, :2]])
    search_settings = settings.search
    return ClearanceMap(clearance, points, search_settings.map_room, search_settings.map_cell), margin


def pose_text(pose: Sequence[float] | FloatArray) -> str:
    """Format a pose for messages."""
    return f"({pose[0]:g}, {pose[1]:g}, {math.degrees(pose[2]):.0f} deg)"
