"""Simulated obstacle sensors of the robot: a laser scanner with a costmap, and a detector that tracks persons.

Observations are computed from the true world through a sensor model: hidden obstacles are not detected, readings are
noisy and delayed, and rays mark and clear the cells of the costmap, which keeps its state. All positions are in the
frame of the true poses; the localisation error is part of the range noise. The fields of `Observation` have the names
of those of `free_space.Surroundings`, so that `set_obstacles` of the controller and of peers accepts both.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.pose import wrap_angle
from diffdrive_mpc_extras.worlds.settings import Sight
from diffdrive_mpc_extras.worlds.shapes import Mover, Shapes
from diffdrive_mpc_extras.worlds.world import World

UNKNOWN, FREE, OCCUPIED = -1, 0, 100
"""Cell values of nav_msgs/OccupancyGrid."""
_TIME_TOLERANCE = 1e-9
_HIT_TOLERANCE = 0.03
"""Distance from an obstacle below which the end of a ray counts as a hit [m]."""
_SPAWN_KEY = 3_003


@dataclass(frozen=True, eq=False)
class Costmap:
    """Costmap with cells aligned with the axes of the frame of the poses.

    Attributes
    ----------
    cells
        (rows, columns) int8, -1 unknown, 0 free, 100 occupied; rows along y.
    resolution
        Side of a cell [m].
    origin
        (x, y, 0) corner of the first cell [m].
    """

    cells: NDArray[np.int8]
    resolution: float
    origin: tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class DetectedDisc:
    """Post or tracked person: position [m], radius [m] and velocity [m/s] in the frame of the poses."""

    x: float
    y: float
    radius: float
    vx: float = 0.0
    vy: float = 0.0


@dataclass(frozen=True, eq=False)
class Observation:
    """Obstacles that the sensors detected at one instant.

    Attributes
    ----------
    time
        Instant of the measurement [s].
    grid
        Costmap for the sight kind "grid", else None.
    polygons
        (k, 2) outlines of obstacles that a ray has hit [m] for the sight kind "shapes", else empty.
    discs
        Tracked persons and, for the sight kind "shapes", round obstacles that a ray has hit.
    corridor
        None: no region to drive in is prescribed.
    """

    time: float
    grid: Costmap | None
    polygons: tuple[FloatArray, ...]
    discs: tuple[DetectedDisc, ...]
    corridor: None = None


class ObstacleSensors:
    """Obstacle sensors of the robot in a world.

    Parameters
    ----------
    world
        World around the robot.
    seed
        Seed of the noise, not negative.
    """

    def __init__(self, world: World, seed: int) -> None:
        self._world, self._sight, self._seed = world, world.sight, seed
        self.reset()

    def reset(self) -> None:
        """Delete costmap, tracks and pending observations, and restart the noise from the seed."""
        self._random = np.random.default_rng(np.random.SeedSequence(self._seed, spawn_key=(_SPAWN_KEY,)))
        self._next_time = 0.0
        self._pending: deque[tuple[float, Observation]] = deque()
        self._costmap: _RollingCostmap | None = None
        self._detected: set[bytes] = set()
        self._tracks: dict[int, _Track] = {}

    def observe(self, time: float, pose: ArrayLike) -> Observation | None:
        """Measure from the true `pose` (3,) if a measurement is due at `time` [s].

        Return the newest observation that has arrived since the last call; None without a new observation.
        """
        if time >= self._next_time - _TIME_TOLERANCE:
            self._next_time += self._sight.period
            self._pending.append((time + self._sight.latency, self._measure(time, np.asarray(pose, dtype=float))))
        arrived = None
        while self._pending and self._pending[0][0] <= time + _TIME_TOLERANCE:
            arrived = self._pending.popleft()[1]
        return arrived

    def _measure(self, time: float, pose: FloatArray) -> Observation:
        sight, shapes = self._sight, self._world.shapes(time)
        distances, bearings = cast_rays(pose, shapes, sight)
        persons = self._persons(time, pose, shapes)
        if sight.kind == "shapes":
            polygons, posts = self._detected_shapes(pose, shapes, distances, bearings)
            return Observation(time, None, polygons, (*posts, *persons))
        measured = distances + sight.range_sd * self._random.standard_normal(len(distances))
        if self._costmap is None:
            self._costmap = _RollingCostmap(sight)
        self._costmap.insert(pose, np.where(np.isfinite(distances), measured, np.inf), bearings)
        return Observation(time, self._costmap.grid(self._random), (), persons)

    def _detected_shapes(
        self, pose: FloatArray, shapes: Shapes, distances: FloatArray, bearings: FloatArray
    ) -> tuple[tuple[FloatArray, ...], list[DetectedDisc]]:
        """Return the standing obstacles that a ray has hit so far."""
        hit = np.isfinite(distances)
        ends = pose[:2] + distances[hit, None] * np.column_stack([np.cos(bearings[hit]), np.sin(bearings[hit])])
        no_discs = np.zeros((0, 3))
        single = [Shapes((polygon,), no_discs) for polygon in shapes.polygons] + [
            Shapes((), disc[None]) for disc in shapes.discs
        ]
        keys = [shape.tobytes() for shape in (*shapes.polygons, *shapes.discs)]
        self._detected &= set(keys)  # delete removed obstacles
        if len(ends):
            undetected = ((k, shape) for k, shape in zip(keys, single, strict=True) if k not in self._detected)
            self._detected.update(k for k, shape in undetected if _is_hit(shape, ends))
        polygons = tuple(polygon for polygon in shapes.polygons if polygon.tobytes() in self._detected)
        return polygons, [DetectedDisc(*disc.tolist()) for disc in shapes.discs if disc.tobytes() in self._detected]

    def _persons(self, time: float, pose: FloatArray, shapes: Shapes) -> tuple[DetectedDisc, ...]:
        """Return the tracked persons: in view, or out of view for less than `person_memory`."""
        persons = []
        for i, mover in enumerate(self._world.movers):
            # Draw for every person at every measurement: the noise does not depend on which persons are in view.
            noise = self._sight.person_sd * self._random.standard_normal(2)
            if not in_view(mover, time, pose, shapes, self._sight):
                track = self._tracks.get(i)
                if track is None or time - track.time > self._sight.person_memory + _TIME_TOLERANCE:
                    self._tracks.pop(i, None)
                    continue
                # A recently detected person is predicted with a constant velocity.
                state = track.predict(time)
            else:
                state = self._update_track(i, time, mover.position(time) + noise)
            (x, vx), (y, vy) = state.T
            persons.append(DetectedDisc(float(x), float(y), mover.radius, float(vx), float(vy)))
        return tuple(persons)

    def _update_track(self, i: int, time: float, position: FloatArray) -> FloatArray:
        """Update the track of a person in view; return its state (2, 2), position [m] and velocity [m/s] by rows."""
        track = self._tracks.get(i)
        if track is None:
            track = self._tracks[i] = _Track(time, position, self._sight)
        else:
            track.update(time, position)
        return track.state


def _is_hit(obstacle: Shapes, ends: FloatArray) -> bool:
    return bool(obstacle.distance(ends).min() < _HIT_TOLERANCE)


def in_view(mover: Mover, time: float, pose: FloatArray, shapes: Shapes, sight: Sight) -> bool:
    """Return True if a mover is visible at `time` [s] from a robot at `pose` (3,).

    Its centre or one of its two edges must be in the range and field of view, and not behind an obstacle.
    """
    if time < mover.seen_from - _TIME_TOLERANCE:
        return False
    offset = mover.position(time) - pose[:2]
    distance = float(np.hypot(*offset))
    if distance > sight.range + mover.radius:
        return False
    if distance <= mover.radius:
        return True
    centre = math.atan2(offset[1], offset[0])
    half_width = math.asin(mover.radius / distance)
    for bearing in (centre, centre - 0.9 * half_width, centre + 0.9 * half_width):
        if abs(float(wrap_angle(bearing - pose[2]))) > 0.5 * sight.field_of_view:
            continue
        free_distance = _first_hits(pose[:2], np.array([bearing]), shapes)[0]
        if free_distance >= distance - mover.radius:
            return True
    return False


def cast_rays(pose: FloatArray, shapes: Shapes, sight: Sight) -> tuple[FloatArray, FloatArray]:
    """Cast rays from `pose` (3,); return ranges (rays,) [m], infinite without a hit, and bearings (rays,) [rad]."""
    half = 0.5 * sight.field_of_view
    bearings = pose[2] + np.linspace(-half, half, sight.rays)
    distances = _first_hits(pose[:2], bearings, shapes)
    return np.where(distances <= sight.range, distances, np.inf), bearings


def _first_hits(origin: FloatArray, bearings: FloatArray, shapes: Shapes) -> FloatArray:
    """Compute distances (rays,) from `origin` (2,) to the first obstacle on each ray [m]; infinite without a hit."""
    direction = np.column_stack([np.cos(bearings), np.sin(bearings)])
    ranges = np.full(len(bearings), np.inf)
    if len(shapes.discs):
        centre = shapes.discs[:, :2] - origin
        longitudinal = direction @ centre.T
        lateral = direction[:, :1] * centre[:, 1] - direction[:, 1:] * centre[:, 0]
        discriminant = shapes.discs[:, 2] ** 2 - lateral**2
        distance = longitudinal - np.sqrt(np.maximum(discriminant, 0.0))
        ranges = np.where((discriminant >= 0) & (distance >= 0), distance, np.inf).min(axis=1)
    for corners in shapes.polygons:
        start, edge = corners - origin, np.roll(corners, -1, axis=0) - corners
        cross = direction[:, :1] * edge[:, 1] - direction[:, 1:] * edge[:, 0]
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = (start[:, 0] * edge[:, 1] - start[:, 1] * edge[:, 0]) / cross
            fraction = (start[:, 0] * direction[:, 1:] - start[:, 1] * direction[:, :1]) / cross
        hit = (np.abs(cross) > 1e-12) & (distance >= 0) & (fraction >= 0) & (fraction <= 1)
        ranges = np.minimum(ranges, np.where(hit, distance, np.inf).min(axis=1))
    return ranges


class _RollingCostmap:
    """Square costmap that moves with the robot by whole cells."""

    def __init__(self, sight: Sight) -> None:
        self._sight = sight
        self._side = 2 * math.ceil(0.5 * sight.size / sight.resolution)
        self._cells = np.full((self._side, self._side), UNKNOWN, dtype=np.int8)
        self._corner: NDArray[np.int64] | None = None

    def insert(self, pose: FloatArray, distances: FloatArray, bearings: FloatArray) -> None:
        """Clear the cells that rays crossed, then mark the cells of their end points."""
        self._move(pose[:2])
        resolution, lengths = self._sight.resolution, np.minimum(distances, self._sight.range)
        direction = np.column_stack([np.cos(bearings), np.sin(bearings)])
        steps = np.arange(0.0, self._sight.range, 0.5 * resolution)
        crossed = steps[None] < lengths[:, None] - 0.5 * resolution
        points = pose[:2] + (steps[None, :, None] * direction[:, None])[crossed]
        self._write(points, FREE)
        hit = np.isfinite(distances)
        # A tenth of a cell behind the surface, so that noise marks the cell before the surface less often.
        self._write(pose[:2] + (distances[hit, None] + 0.1 * resolution) * direction[hit], OCCUPIED)

    def grid(self, random: np.random.Generator) -> Costmap:
        """Return the current cells, with a random share inverted."""
        cells = self._cells.copy()
        if self._sight.flipped > 0:
            flipped = random.random(cells.shape) < self._sight.flipped
            cells[flipped] = np.where(cells[flipped] == OCCUPIED, FREE, OCCUPIED)
        assert self._corner is not None
        x, y = (self._corner * self._sight.resolution).tolist()
        return Costmap(cells, self._sight.resolution, (x, y, 0.0))

    def _write(self, points: FloatArray, value: int) -> None:
        """Set the cells of points (n, 2) [m] inside the square."""
        assert self._corner is not None
        columns, rows = (np.floor(points / self._sight.resolution).astype(np.int64) - self._corner).T
        inside = (columns >= 0) & (columns < self._side) & (rows >= 0) & (rows < self._side)
        self._cells[rows[inside], columns[inside]] = value

    def _move(self, centre: FloatArray) -> None:
        """Move the square to a centre (2,) [m]; new cells are unknown."""
        corner = np.floor(centre / self._sight.resolution).astype(np.int64) - self._side // 2
        if self._corner is None:
            self._corner = corner
            return
        columns, rows = (corner - self._corner).tolist()
        moved = np.full_like(self._cells, UNKNOWN)
        if abs(columns) < self._side and abs(rows) < self._side:
            target = [slice(max(0, -k), self._side - max(0, k)) for k in (rows, columns)]
            source = [slice(max(0, k), self._side - max(0, -k)) for k in (rows, columns)]
            moved[target[0], target[1]] = self._cells[source[0], source[1]]
        self._cells, self._corner = moved, corner


class _Track:
    """Kalman filter of one person with constant velocity and acceleration noise, equal for both axes."""

    def __init__(self, time: float, position: FloatArray, sight: Sight) -> None:
        self.time, self._noise = time, max(sight.person_sd, 1e-3) ** 2
        self._acceleration_variance = sight.person_acceleration**2
        self.state = np.array([position, np.zeros(2)])
        self._covariance = np.diag([self._noise, 1.0])

    def predict(self, time: float) -> FloatArray:
        """Predict the state (2, 2), position [m] and velocity [m/s] by rows, at `time` [s]."""
        return np.asarray(np.array([[1.0, time - self.time], [0.0, 1.0]]) @ self.state)

    def update(self, time: float, position: FloatArray) -> None:
        """Update the state with a measured position (2,) [m] at `time` [s]."""
        dt = time - self.time
        self.time = time
        transition = np.array([[1.0, dt], [0.0, 1.0]])
        process_noise = self._acceleration_variance * np.array([[dt**4 / 4, dt**3 / 2], [dt**3 / 2, dt**2]])
        covariance = transition @ self._covariance @ transition.T + process_noise
        gain = covariance[:, 0] / (covariance[0, 0] + self._noise)
        predicted = transition @ self.state
        self.state = predicted + np.outer(gain, position - predicted[0])
        self._covariance = covariance - np.outer(gain, covariance[0])
