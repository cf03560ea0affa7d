"""Sight of the robot: rays to the first obstacle, a costmap of them, persons and their apparent motion.

Everything comes from the truth through a model of the sensors: hidden objects are not seen, readings are late and
noisy, and the costmap keeps earlier obstacles, like one that is marked and cleared. The frame is that of the true
poses: the error of localisation is that of the rays. The fields of `Seen` have the names that
`mpc.free_space.Surroundings` has, so that `Controller.set_obstacles` and peers take it as it is.
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
"""Cells, as nav_msgs/OccupancyGrid has them."""
_TIME_TOLERANCE = 1e-9
# Tolerance for ends of rays on the outline, where they met a disc or a corner [m].
_ON_OUTLINE = 0.03
_SPAWN_KEY = 3_003


@dataclass(frozen=True, eq=False)
class SeenGrid:
    """A costmap, whose cells lie along the axes of the poses' frame.

    Attributes
    ----------
    cells
        (rows, columns) int8, -1 unknown, 0 free, 100 occupied; rows along y.
    resolution
        Side of a cell [m].
    origin
        (x, y, 0) of the corner of the first cell [m].
    """

    cells: NDArray[np.int8]
    resolution: float
    origin: tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class SeenDisc:
    """A post, or a person as the detector has it: place, radius [m] and velocity [m/s], in the frame of the poses."""

    x: float
    y: float
    radius: float
    vx: float = 0.0
    vy: float = 0.0


@dataclass(frozen=True, eq=False)
class Seen:
    """Result of one look.

    Attributes
    ----------
    time
        The instant that it describes [s].
    grid
        The costmap, where the sight is one.
    polygons
        (k, 2) outlines of obstacles that were seen at least in part [m], where the sight is of shapes.
    discs
        Persons in view, and round obstacles that were seen at least in part, where the sight is of shapes.
    corridor
        None: no region to drive in is prescribed.
    """

    time: float
    grid: SeenGrid | None
    polygons: tuple[FloatArray, ...]
    discs: tuple[SeenDisc, ...]
    corridor: None = None


class Eyes:
    """Looks at a world from the robot, again and again.

    Parameters
    ----------
    world
        World that is seen.
    seed
        Seed of the noise, not negative.
    """

    def __init__(self, world: World, seed: int) -> None:
        self._world, self._sight, self._seed = world, world.sight, seed
        self.reset()

    def reset(self) -> None:
        """Forget everything and restart the noise from the seed."""
        self._random = np.random.default_rng(np.random.SeedSequence(self._seed, spawn_key=(_SPAWN_KEY,)))
        self._next = 0.0
        self._coming: deque[tuple[float, Seen]] = deque()
        self._map: _RollingMap | None = None
        self._known: set[bytes] = set()
        self._tracks: dict[int, _Track] = {}

    def look(self, time: float, pose: ArrayLike) -> Seen | None:
        """Look, if it is time to, from the true `pose` (3,); the last look that has arrived, or None for no news."""
        if time >= self._next - _TIME_TOLERANCE:
            self._next += self._sight.period
            self._coming.append((time + self._sight.latency, self._one(time, np.asarray(pose, dtype=float))))
        arrived = None
        while self._coming and self._coming[0][0] <= time + _TIME_TOLERANCE:
            arrived = self._coming.popleft()[1]
        return arrived

    def _one(self, time: float, pose: FloatArray) -> Seen:
        sight, shapes = self._sight, self._world.shapes(time)
        distances, bearings = cast_rays(pose, shapes, sight)
        persons = self._persons(time, pose, shapes)
        if sight.kind == "shapes":
            polygons, posts = self._outlines(pose, shapes, distances, bearings)
            return Seen(time, None, polygons, (*posts, *persons))
        measured = distances + sight.range_sd * self._random.standard_normal(len(distances))
        if self._map is None:
            self._map = _RollingMap(sight)
        self._map.enter(pose, np.where(np.isfinite(distances), measured, np.inf), bearings)
        return Seen(time, self._map.grid(self._random), (), persons)

    def _outlines(
        self, pose: FloatArray, shapes: Shapes, distances: FloatArray, bearings: FloatArray
    ) -> tuple[tuple[FloatArray, ...], list[SeenDisc]]:
        """Return standing obstacles that a ray has met so far."""
        met = np.isfinite(distances)
        ends = pose[:2] + distances[met, None] * np.column_stack([np.cos(bearings[met]), np.sin(bearings[met])])
        nothing = np.zeros((0, 3))
        single = [Shapes((polygon,), nothing) for polygon in shapes.polygons] + [
            Shapes((), disc[None]) for disc in shapes.discs
        ]
        keys = [shape.tobytes() for shape in (*shapes.polygons, *shapes.discs)]
        self._known &= set(keys)  # removed obstacles are deleted
        if len(ends):
            new = (key for key, shape in zip(keys, single, strict=True) if key not in self._known and _met(shape, ends))
            self._known.update(new)
        polygons = tuple(polygon for polygon in shapes.polygons if polygon.tobytes() in self._known)
        return polygons, [SeenDisc(*disc.tolist()) for disc in shapes.discs if disc.tobytes() in self._known]

    def _persons(self, time: float, pose: FloatArray, shapes: Shapes) -> tuple[SeenDisc, ...]:
        persons = []
        for i, mover in enumerate(self._world.movers):
            # Drawn for every person at every look: the noise is independent of the persons in view.
            noise = self._sight.person_sd * self._random.standard_normal(2)
            if not in_view(mover, time, pose, shapes, self._sight):
                track = self._tracks.get(i)
                if track is None or time - track.time > self._sight.person_memory + _TIME_TOLERANCE:
                    self._tracks.pop(i, None)
                    continue
                # A person who was seen a moment ago is assumed to walk on.
                state = track.predict(time)
            else:
                state = self._update(i, time, mover.position(time) + noise)
            (x, vx), (y, vy) = state.T
            persons.append(SeenDisc(float(x), float(y), mover.radius, float(vx), float(vy)))
        return tuple(persons)

    def _update(self, i: int, time: float, place: FloatArray) -> FloatArray:
        """Update the estimate (2, 2) of a person in view: place [m], and velocity [m/s]."""
        track = self._tracks.get(i)
        if track is None:
            track = self._tracks[i] = _Track(time, place, self._sight)
        else:
            track.update(time, place)
        return track.state


def _met(obstacle: Shapes, ends: FloatArray) -> bool:
    return bool(obstacle.distance(ends).min() < _ON_OUTLINE)


def in_view(mover: Mover, time: float, pose: FloatArray, shapes: Shapes, sight: Sight) -> bool:
    """Return True if a mover is within range and field of view of a robot at `pose` (3,), and not hidden at `time` [s].

    It is seen where its middle or one of its two flanks can be.
    """
    if time < mover.seen_from - _TIME_TOLERANCE:
        return False
    gap = mover.position(time) - pose[:2]
    distance = float(np.hypot(*gap))
    if distance > sight.range + mover.radius:
        return False
    if distance <= mover.radius:
        return True
    bearing = math.atan2(gap[1], gap[0])
    flank = math.asin(mover.radius / distance)
    for to in (bearing, bearing - 0.9 * flank, bearing + 0.9 * flank):
        if abs(float(wrap_angle(to - pose[2]))) > 0.5 * sight.field_of_view:
            continue
        free = _first_hits(pose[:2], np.array([to]), shapes)[0]
        if free >= distance - mover.radius:
            return True
    return False


def cast_rays(pose: FloatArray, shapes: Shapes, sight: Sight) -> tuple[FloatArray, FloatArray]:
    """Cast rays; return distances (rays,) [m], infinite beyond the range, and directions (rays,) [rad]."""
    half = 0.5 * sight.field_of_view
    bearings = pose[2] + np.linspace(-half, half, sight.rays)
    distances = _first_hits(pose[:2], bearings, shapes)
    return np.where(distances <= sight.range, distances, np.inf), bearings


def _first_hits(eye: FloatArray, bearings: FloatArray, shapes: Shapes) -> FloatArray:
    """Compute the distance (rays,) of the first obstacle in each direction [m], infinite without one."""
    along = np.column_stack([np.cos(bearings), np.sin(bearings)])
    ranges = np.full(len(bearings), np.inf)
    if len(shapes.discs):
        middle = shapes.discs[:, :2] - eye
        ahead = along @ middle.T
        aside = along[:, :1] * middle[:, 1] - along[:, 1:] * middle[:, 0]
        inside = shapes.discs[:, 2] ** 2 - aside**2
        reach = ahead - np.sqrt(np.maximum(inside, 0.0))
        ranges = np.where((inside >= 0) & (reach >= 0), reach, np.inf).min(axis=1)
    for corners in shapes.polygons:
        start, edge = corners - eye, np.roll(corners, -1, axis=0) - corners
        across = along[:, :1] * edge[:, 1] - along[:, 1:] * edge[:, 0]
        with np.errstate(divide="ignore", invalid="ignore"):
            reach = (start[:, 0] * edge[:, 1] - start[:, 1] * edge[:, 0]) / across
            share = (start[:, 0] * along[:, 1:] - start[:, 1] * along[:, :1]) / across
        met = (np.abs(across) > 1e-12) & (reach >= 0) & (share >= 0) & (share <= 1)
        ranges = np.minimum(ranges, np.where(met, reach, np.inf).min(axis=1))
    return ranges


class _RollingMap:
    """Cells by whole numbers of the frame of the poses, in one square that moves with the robot by whole cells."""

    def __init__(self, sight: Sight) -> None:
        self._sight = sight
        self._side = 2 * math.ceil(0.5 * sight.size / sight.resolution)
        self._cells = np.full((self._side, self._side), UNKNOWN, dtype=np.int8)
        self._corner: NDArray[np.int64] | None = None

    def enter(self, pose: FloatArray, distances: FloatArray, bearings: FloatArray) -> None:
        """Clear cells that rays have passed, then mark those where they ended."""
        self._move(pose[:2])
        resolution, reach = self._sight.resolution, np.minimum(distances, self._sight.range)
        along = np.column_stack([np.cos(bearings), np.sin(bearings)])
        steps = np.arange(0.0, self._sight.range, 0.5 * resolution)
        passed = steps[None] < reach[:, None] - 0.5 * resolution
        points = pose[:2] + (steps[None, :, None] * along[:, None])[passed]
        self._write(points, FREE)
        met = np.isfinite(distances)
        # Half a ray's noise behind the surface: else its cell would be the one before it as often.
        self._write(pose[:2] + (distances[met, None] + 0.1 * resolution) * along[met], OCCUPIED)

    def grid(self, random: np.random.Generator) -> SeenGrid:
        """Return the present square, with wrong cells."""
        cells = self._cells.copy()
        if self._sight.flipped > 0:
            wrong = random.random(cells.shape) < self._sight.flipped
            cells[wrong] = np.where(cells[wrong] == OCCUPIED, FREE, OCCUPIED)
        assert self._corner is not None
        x, y = (self._corner * self._sight.resolution).tolist()
        return SeenGrid(cells, self._sight.resolution, (x, y, 0.0))

    def _write(self, points: FloatArray, value: int) -> None:
        assert self._corner is not None
        columns, rows = (np.floor(points / self._sight.resolution).astype(np.int64) - self._corner).T
        inside = (columns >= 0) & (columns < self._side) & (rows >= 0) & (rows < self._side)
        self._cells[rows[inside], columns[inside]] = value

    def _move(self, middle: FloatArray) -> None:
        corner = np.floor(middle / self._sight.resolution).astype(np.int64) - self._side // 2
        if self._corner is None:
            self._corner = corner
            return
        columns, rows = (corner - self._corner).tolist()
        fresh = np.full_like(self._cells, UNKNOWN)
        if abs(columns) < self._side and abs(rows) < self._side:
            to = [slice(max(0, -k), self._side - max(0, k)) for k in (rows, columns)]
            source = [slice(max(0, k), self._side - max(0, -k)) for k in (rows, columns)]
            fresh[to[0], to[1]] = self._cells[source[0], source[1]]
        self._cells, self._corner = fresh, corner


class _Track:
    """Kalman filter of one person: constant velocity under white acceleration, both axes alike."""

    def __init__(self, time: float, place: FloatArray, sight: Sight) -> None:
        self.time, self._noise = time, max(sight.person_sd, 1e-3) ** 2
        self._power = sight.person_acceleration**2
        self.state = np.array([place, np.zeros(2)])
        self._covariance = np.diag([self._noise, 1.0])

    def predict(self, time: float) -> FloatArray:
        """Predict place [m] and velocity [m/s] (2, 2) for `time` without further sightings."""
        return np.asarray(np.array([[1.0, time - self.time], [0.0, 1.0]]) @ self.state)

    def update(self, time: float, place: FloatArray) -> None:
        """Take in one more look."""
        dt = time - self.time
        self.time = time
        move = np.array([[1.0, dt], [0.0, 1.0]])
        grown = self._power * np.array([[dt**4 / 4, dt**3 / 2], [dt**3 / 2, dt**2]])
        covariance = move @ self._covariance @ move.T + grown
        gain = covariance[:, 0] / (covariance[0, 0] + self._noise)
        predicted = move @ self.state
        self.state = predicted + np.outer(gain, place - predicted[0])
        self._covariance = covariance - np.outer(gain, covariance[0])
