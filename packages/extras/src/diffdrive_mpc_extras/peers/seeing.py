"""Peers with obstacle avoidance: pursuit with Nav2's collision stop, and MPPI with detected obstacles in its cost.

Both receive the obstacle data of this project's controller (`worlds.sight.Observation`): grid and persons. Both assume
that persons stand still at their detected positions, as in a costmap. Nav2's paths have no times; here the reference
time waits for a lagging robot.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.ndimage import distance_transform_edt

from diffdrive_mpc.bench.peers.pursuit import PursuitGains, PursuitLaw
from diffdrive_mpc.bench.peers.tracking_peer import (
    MODEL,
    AboveZero,
    Law,
    LawInput,
    RobotParameters,
    TrackingPeer,
    robot_parameters,
)
from diffdrive_mpc.models.checked_yaml import StrictModel, load_checked
from diffdrive_mpc.models.interface import FloatArray, Reference
from diffdrive_mpc.models.pose import ahead_and_left, integrate_pose
from diffdrive_mpc.mpc import load_config
from diffdrive_mpc.mpc.estimate import Estimate
from diffdrive_mpc_extras.peers.mppi import Floats32, MppiGains, MppiLaw
from diffdrive_mpc_extras.worlds.passage import outline_points
from diffdrive_mpc_extras.worlds.shapes import Shapes
from diffdrive_mpc_extras.worlds.sight import OCCUPIED, Observation

_NO_OBSTACLE = 10.0
"""Distance in areas without obstacles [m]."""
_CELL_SIZE = 0.025
"""Cell size of the grid for shapes [m]."""
_SPEED_SAMPLES = 200
_HALF_SIDE = 2.5
"""Half the side length of the grid for shapes, which is centred at the robot [m]."""


class StoppingPursuit(StrictModel):
    """Settings of regulated pure pursuit with a collision stop."""

    wait: AboveZero = Field(description="longitudinal lag from which the reference time slows down [m]")
    gains: PursuitGains = Field(description="gains of the law")
    time_before_collision: AboveZero = Field(description="horizon of the collision check [s]")
    step: AboveZero = Field(description="distance between two checked poses [m]")


class GridMppi(StrictModel):
    """Settings of MPPI with a grid."""

    wait: AboveZero = Field(description="longitudinal lag from which the reference time slows down [m]")
    samples: Annotated[int, Field(ge=1)] = Field(description="number of sampled plans")
    steps: Annotated[int, Field(ge=2)] = Field(description="number of steps of a plan")
    ticks: Annotated[int, Field(ge=1)] = Field(description="number of ticks of a step")
    collision: AboveZero = Field(description="cost of a step with a collision [-]")
    pace: AboveZero = Field(description="maximum speed over the maximum speed of the reference [-]")
    repulsion: AboveZero = Field(description="cost of a step at zero distance [-]")
    reach: AboveZero = Field(description="decay length of the repulsion [m]")
    gains: MppiGains = Field(description="gains of the law")


class SeeingSettings(StrictModel):
    """Settings in `seeing.yaml`."""

    outline: tuple[float, float] = Field(description="length and width of the robot [m]")
    rpp: StoppingPursuit
    mppi: GridMppi


@cache
def seeing_settings() -> SeeingSettings:
    """Load the shipped settings; raise ConfigError if the file is invalid."""
    return load_checked(SeeingSettings, Path(__file__).parent / "seeing.yaml")


class SeenDistanceField:
    """Grid of distances to the nearest detected obstacle.

    Parameters
    ----------
    obstacles
        Latest detected obstacles.
    position
        (2,) position of the robot [m], the centre of the grid if `obstacles` has no grid.
    """

    def __init__(self, obstacles: Observation, position: FloatArray) -> None:
        discs = np.array([[disc.x, disc.y, disc.radius] for disc in obstacles.discs]).reshape(-1, 3)
        if obstacles.grid is not None:
            self._resolution, self._origin = obstacles.grid.resolution, np.array(obstacles.grid.origin[:2])
            occupied = obstacles.grid.cells >= OCCUPIED // 2
            # Measure distances to the edge of an occupied cell instead of its centre.
            field = distance_transform_edt(~occupied) * self._resolution - 0.5 * self._resolution
            self._field = np.where(occupied, 0.0, field) if occupied.any() else np.full(occupied.shape, _NO_OBSTACLE)
        else:
            count = round(2 * _HALF_SIDE / _CELL_SIZE)
            self._resolution, self._origin = _CELL_SIZE, position - _HALF_SIDE
            self._field = np.full((count, count), _NO_OBSTACLE)
        shapes = Shapes(obstacles.polygons, discs)
        if len(discs) or obstacles.polygons:
            rows, columns = self._field.shape
            x = self._origin[0] + self._resolution * (np.arange(columns) + 0.5)
            y = self._origin[1] + self._resolution * (np.arange(rows) + 0.5)
            points = np.column_stack([axis.ravel() for axis in np.meshgrid(x, y)])
            self._field = np.minimum(self._field, shapes.distance(points).reshape(rows, columns))
        self._field = np.pad(self._field, 1, constant_values=_NO_OBSTACLE).astype(np.float32)
        self._max_index = np.array(self._field.shape)[::-1] - 1

    def distances(self, x: NDArray[np.floating], y: NDArray[np.floating]) -> Floats32:
        """Return distances [m], in the shape of x and y [m] in the frame of the poses; 10 m outside the grid."""
        column = np.clip(((x - self._origin[0]) / self._resolution + 1).astype(np.int32), 0, self._max_index[0])
        row = np.clip(((y - self._origin[1]) / self._resolution + 1).astype(np.int32), 0, self._max_index[1])
        distances: Floats32 = self._field[row, column]
        return distances


class SeeingPeer(TrackingPeer):
    """Tracking peer with a reference time that waits for the robot, and with the latest obstacles for its law."""

    def __init__(self, law: Law, lead: float, wait: float) -> None:
        super().__init__(law, lead, side_slip=True, config=load_config(MODEL))
        self._wait = wait
        self._new_obstacles: Observation | None = None
        self._distance_field: SeenDistanceField | None = None

    def start(self, reference: Reference, t0: float) -> None:
        """Start tracking `reference`, whose time 0 is `t0` [s], without obstacles."""
        super().start(reference, t0)
        self._progress, self._last_time = 0.0, t0
        self._new_obstacles, self._distance_field = None, None

    def set_obstacles(self, obstacles: Observation, /) -> None:
        """Store the latest detected obstacles."""
        self._new_obstacles = obstacles

    def _reference_time(self, t: float, estimate: Estimate | None) -> float:
        elapsed, self._last_time = t - self._last_time, t
        if estimate is None or self._reference is None:
            return self._progress
        if self._new_obstacles is not None:
            self._distance_field, self._new_obstacles = SeenDistanceField(self._new_obstacles, estimate.pose[:2]), None
        pose = self._reference.sample([self._progress]).pose[0]
        lag = float(ahead_and_left(pose - estimate.pose, pose[2])[0])
        self._progress += elapsed * float(np.clip(2.0 - lag / self._wait, 0.0, 1.0))
        return self._progress


class PursuitThatStops(SeeingPeer):
    """Regulated pure pursuit that stops if the robot would hit a detected obstacle at a constant command."""

    def __init__(self) -> None:
        settings = seeing_settings()
        law = PursuitLaw(settings.rpp.gains, robot_parameters(load_config(MODEL)))
        super().__init__(law, settings.rpp.gains.lead, settings.rpp.wait)
        self._stop, self._outline = settings.rpp, outline_points(settings.outline)

    def _limit_twist(self, twist: FloatArray, sight: LawInput) -> tuple[FloatArray, str]:
        if self._distance_field is None:
            return twist, ""
        v, omega = twist
        reach = max(abs(v), abs(omega) * float(np.hypot(*self._outline.T).max())) * self._stop.time_before_collision
        times = np.linspace(0.0, self._stop.time_before_collision, max(2, int(np.ceil(reach / self._stop.step)) + 1))
        poses = integrate_pose(sight.motion.pose, np.full(len(times), v), np.full(len(times), omega), times)
        c, s = np.cos(poses[:, 2])[:, None], np.sin(poses[:, 2])[:, None]
        x = poses[:, :1] + c * self._outline[:, 0] - s * self._outline[:, 1]
        y = poses[:, 1:2] + s * self._outline[:, 0] + c * self._outline[:, 1]
        is_collision = (self._distance_field.distances(x, y) <= 0).any(axis=1)
        if not is_collision.any():
            return twist, ""
        return np.zeros(2), f"the command would cause a collision in {times[int(np.argmax(is_collision))]:.1f} s"


class GridMppiLaw(MppiLaw):
    """MPPI with an additional cost of the distance between the robot, as four discs, and detected obstacles."""

    def __init__(self, settings: GridMppi, robot: RobotParameters, outline: tuple[float, float]) -> None:
        coarse_robot = RobotParameters(robot.sample_time * settings.ticks, robot.time_constant, robot.limits)
        super().__init__(settings.gains, coarse_robot, settings.samples, settings.steps)
        self._settings = settings
        self.distance_field: SeenDistanceField | None = None
        quarter = 0.25 * np.array(outline)
        self._discs = quarter * np.array([[1, 1], [1, -1], [-1, 1], [-1, -1]])
        self._radius = float(np.hypot(*quarter))
        self._tick, self._command = 0, np.zeros(2)
        self._robot_v = robot.limits.v

    def start(self, reference: Reference) -> None:
        """Start tracking `reference`."""
        super().start(reference)
        self._tick, self._command, self.distance_field = 0, np.zeros(2), None
        # Limit the speed relative to the reference, as with Nav2's vx_max, to avoid high speeds in narrow places.
        speed = np.abs(reference.sample(np.linspace(0.0, reference.duration, _SPEED_SAMPLES)).twist[:, 0]).max()
        self._limits[0] = min(self._robot_v, self._settings.pace * speed)

    def decide(self, sight: LawInput) -> FloatArray:
        """Compute the desired v [m/s] and omega [rad/s] (2,); compute a new plan once per step."""
        if self._tick == 0:
            self._command = super().decide(sight)
        self._tick = (self._tick + 1) % self._settings.ticks
        return self._command

    def _additional_cost(self, sight: LawInput, x: Floats32, y: Floats32, rotation: Floats32) -> Floats32 | None:
        if self.distance_field is None:
            return None
        robot_x, robot_y, heading = sight.motion.pose
        c, s = np.float32(np.cos(heading)), np.float32(np.sin(heading))
        theta = rotation + np.float32(heading)
        cos, sin = np.cos(theta), np.sin(theta)
        middle_x, middle_y = np.float32(robot_x) + c * x - s * y, np.float32(robot_y) + s * x + c * y
        gap = np.full(x.shape, _NO_OBSTACLE, dtype=np.float32)
        for ahead, left in self._discs.astype(np.float32):
            disc_x, disc_y = middle_x + ahead * cos - left * sin, middle_y + ahead * sin + left * cos
            distance = self.distance_field.distances(disc_x, disc_y)
            np.minimum(gap, distance - np.float32(self._radius), out=gap)
        settings = self._settings
        cost = np.where(gap <= 0, settings.collision, settings.repulsion * np.exp(-np.maximum(gap, 0) / settings.reach))
        return np.asarray(cost.sum(axis=1), dtype=np.float32)


class MppiWithGrid(SeeingPeer):
    """MPPI with detected obstacles in its cost."""

    def __init__(self) -> None:
        settings = seeing_settings()
        law = GridMppiLaw(settings.mppi, robot_parameters(load_config(MODEL)), settings.outline)
        super().__init__(law, settings.mppi.gains.lead, settings.mppi.wait)
        self._grid_law = law

    def _reference_time(self, t: float, estimate: Estimate | None) -> float:
        progress = super()._reference_time(t, estimate)
        self._grid_law.distance_field = self._distance_field
        return progress
