"""Peers in a world: pursuit with the collision stop of Nav2, and MPPI with the seen obstacles in its cost.

Both receive the data of our controller (`worlds.sight.Observation`): the same grid, the same persons. Both assume that
persons stand still at the place where they were seen, as in a costmap. Nav2's paths have no times: the reference's
clock waits here for a robot that lags.
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
from diffdrive_mpc.bench.peers.tracking_peer import MODEL, AboveZero, Delayed, Law, LawInput, TrackingPeer, law_data
from diffdrive_mpc.models.checked_yaml import StrictModel, load_checked
from diffdrive_mpc.models.interface import FloatArray, Reference
from diffdrive_mpc.models.pose import ahead_and_left, integrate_pose
from diffdrive_mpc.mpc import load_config
from diffdrive_mpc.mpc.estimate import Estimate
from diffdrive_mpc_extras.peers.mppi import Floats32, MppiGains, MppiLaw
from diffdrive_mpc_extras.worlds.passage import outline_points
from diffdrive_mpc_extras.worlds.shapes import Shapes
from diffdrive_mpc_extras.worlds.sight import OCCUPIED, Observation

_FAR = 10.0
"""Distance where nothing has been seen [m]."""
_FINE = 0.025
"""Cells that shapes are drawn into [m]."""
_PACES = 200
_HALF_SIDE = 2.5
"""Half side of the square around the robot in which obstacles are drawn [m]."""


class StoppingPursuit(StrictModel):
    """Regulated pure pursuit with a collision stop."""

    wait: AboveZero = Field(description="lag along the path from which the reference's clock slows down [m]")
    gains: PursuitGains = Field(description="of the law")
    time_before_collision: AboveZero = Field(description="how far ahead the command is projected [s]")
    step: AboveZero = Field(description="between two poses that are checked [m]")


class GridMppi(StrictModel):
    """MPPI with a grid."""

    wait: AboveZero = Field(description="lag along the path from which the reference's clock slows down [m]")
    samples: Annotated[int, Field(ge=1)] = Field(description="plans")
    steps: Annotated[int, Field(ge=2)] = Field(description="of a plan")
    ticks: Annotated[int, Field(ge=1)] = Field(description="of a step")
    collision: AboveZero = Field(description="cost of a step that touches something")
    pace: AboveZero = Field(description="fastest over the reference's fastest")
    repulsion: AboveZero = Field(description="cost of a step at zero distance")
    reach: AboveZero = Field(description="over which that falls off [m]")
    gains: MppiGains = Field(description="of the law")


class SeeingSettings(StrictModel):
    """Everything in `seeing.yaml`."""

    outline: tuple[float, float] = Field(description="length and width of the robot [m]")
    rpp: StoppingPursuit
    mppi: GridMppi


@cache
def seeing_settings() -> SeeingSettings:
    """Load the shipped settings."""
    return load_checked(SeeingSettings, Path(__file__).parent / "seeing.yaml")


class SeenDistanceField:
    """Distance to the nearest thing that was seen, looked up cell by cell.

    Parameters
    ----------
    obstacles
        Obstacles of the last look.
    position
        (2,) of the robot [m]: shapes are drawn into a square around it.
    """

    def __init__(self, obstacles: Observation, position: FloatArray) -> None:
        discs = np.array([[disc.x, disc.y, disc.radius] for disc in obstacles.discs]).reshape(-1, 3)
        if obstacles.grid is not None:
            self._resolution, self._origin = obstacles.grid.resolution, np.array(obstacles.grid.origin[:2])
            occupied = obstacles.grid.cells >= OCCUPIED // 2
            # To the near side of a cell, not to its middle.
            field = distance_transform_edt(~occupied) * self._resolution - 0.5 * self._resolution
            self._field = np.where(occupied, 0.0, field) if occupied.any() else np.full(occupied.shape, _FAR)
        else:
            count = round(2 * _HALF_SIDE / _FINE)
            self._resolution, self._origin = _FINE, position - _HALF_SIDE
            self._field = np.full((count, count), _FAR)
        shapes = Shapes(obstacles.polygons, discs)
        if len(discs) or obstacles.polygons:
            rows, columns = self._field.shape
            x = self._origin[0] + self._resolution * (np.arange(columns) + 0.5)
            y = self._origin[1] + self._resolution * (np.arange(rows) + 0.5)
            points = np.column_stack([axis.ravel() for axis in np.meshgrid(x, y)])
            self._field = np.minimum(self._field, shapes.distance(points).reshape(rows, columns))
        self._field = np.pad(self._field, 1, constant_values=_FAR).astype(np.float32)
        self._most = np.array(self._field.shape)[::-1] - 1

    def distances(self, x: NDArray[np.floating], y: NDArray[np.floating]) -> Floats32:
        """Return the distance [m] at points in the frame of the poses, of their shape; far away outside the field."""
        column = np.clip(((x - self._origin[0]) / self._resolution + 1).astype(np.int32), 0, self._most[0])
        row = np.clip(((y - self._origin[1]) / self._resolution + 1).astype(np.int32), 0, self._most[1])
        distances: Floats32 = self._field[row, column]
        return distances


class SeeingPeer(TrackingPeer):
    """A tracking peer whose reference waits, and that keeps what was seen for its law."""

    def __init__(self, law: Law, lead: float, wait: float) -> None:
        super().__init__(law, lead, side_slip=True, config=load_config(MODEL))
        self._wait = wait
        self._look: Observation | None = None
        self._around: SeenDistanceField | None = None

    def start(self, reference: Reference, t0: float) -> None:
        """Start as every tracking peer, without obstacles."""
        super().start(reference, t0)
        self._progress, self._last_time = 0.0, t0
        self._look, self._around = None, None

    def set_obstacles(self, obstacles: Observation, /) -> None:
        """Store the received data of a look."""
        self._look = obstacles

    def _since_start(self, t: float, estimate: Estimate | None) -> float:
        passed, self._last_time = t - self._last_time, t
        if estimate is None or self._reference is None:
            return self._progress
        if self._look is not None:
            self._around, self._look = SeenDistanceField(self._look, estimate.pose[:2]), None
        pose = self._reference.sample([self._progress]).pose[0]
        lag = float(ahead_and_left(pose - estimate.pose, pose[2])[0])
        self._progress += passed * float(np.clip(2.0 - lag / self._wait, 0.0, 1.0))
        return self._progress


class PursuitThatStops(SeeingPeer):
    """Regulated pure pursuit; where its command, held on, would touch something seen, it stops."""

    def __init__(self) -> None:
        settings = seeing_settings()
        law = PursuitLaw(settings.rpp.gains, law_data(load_config(MODEL)))
        super().__init__(law, settings.rpp.gains.lead, settings.rpp.wait)
        self._stop, self._outline = settings.rpp, outline_points(settings.outline)

    def _allowed(self, twist: FloatArray, sight: LawInput) -> tuple[FloatArray, str]:
        if self._around is None:
            return twist, ""
        v, omega = twist
        reach = max(abs(v), abs(omega) * float(np.hypot(*self._outline.T).max())) * self._stop.time_before_collision
        times = np.linspace(0.0, self._stop.time_before_collision, max(2, int(np.ceil(reach / self._stop.step)) + 1))
        poses = integrate_pose(sight.motion.pose, np.full(len(times), v), np.full(len(times), omega), times)
        c, s = np.cos(poses[:, 2])[:, None], np.sin(poses[:, 2])[:, None]
        x = poses[:, :1] + c * self._outline[:, 0] - s * self._outline[:, 1]
        y = poses[:, 1:2] + s * self._outline[:, 0] + c * self._outline[:, 1]
        touching = (self._around.distances(x, y) <= 0).any(axis=1)
        if not touching.any():
            return twist, ""
        return np.zeros(2), f"its command would touch something in {times[int(np.argmax(touching))]:.1f} s"


class GridMppiLaw(MppiLaw):
    """MPPI whose plans cost by how near the robot, four discs, comes to what was seen."""

    def __init__(self, settings: GridMppi, robot: Delayed, outline: tuple[float, float]) -> None:
        slower = Delayed(robot.sample_time * settings.ticks, robot.time_constant, robot.limits)
        super().__init__(settings.gains, slower, settings.samples, settings.steps)
        self._settings = settings
        self.around: SeenDistanceField | None = None
        quarter = 0.25 * np.array(outline)
        self._discs = quarter * np.array([[1, 1], [1, -1], [-1, 1], [-1, -1]])
        self._radius = float(np.hypot(*quarter))
        self._waited, self._kept = 0, np.zeros(2)
        self._robot_v = robot.limits.v

    def start(self, reference: Reference) -> None:
        """Start to track `reference`."""
        super().start(reference)
        self._waited, self._kept, self.around = 0, np.zeros(2), None
        # As Nav2's vx_max, which is the speed that is wanted: else it rushes through narrow places.
        pace = np.abs(reference.sample(np.linspace(0.0, reference.duration, _PACES)).twist[:, 0]).max()
        self._most[0] = min(self._robot_v, self._settings.pace * pace)

    def decide(self, sight: LawInput) -> FloatArray:
        """Compute the wanted v [m/s] and omega [rad/s] (2,), with a new plan at intervals."""
        if self._waited == 0:
            self._kept = super().decide(sight)
        self._waited = (self._waited + 1) % self._settings.ticks
        return self._kept

    def _beside(self, sight: LawInput, x: Floats32, y: Floats32, turned: Floats32) -> Floats32 | None:
        if self.around is None:
            return None
        here_x, here_y, heading = sight.motion.pose
        c, s = np.float32(np.cos(heading)), np.float32(np.sin(heading))
        theta = turned + np.float32(heading)
        cos, sin = np.cos(theta), np.sin(theta)
        middle_x, middle_y = np.float32(here_x) + c * x - s * y, np.float32(here_y) + s * x + c * y
        gap = np.full(x.shape, _FAR, dtype=np.float32)
        for ahead, left in self._discs.astype(np.float32):
            distance = self.around.distances(middle_x + ahead * cos - left * sin, middle_y + ahead * sin + left * cos)
            np.minimum(gap, distance - np.float32(self._radius), out=gap)
        settings = self._settings
        cost = np.where(gap <= 0, settings.collision, settings.repulsion * np.exp(-np.maximum(gap, 0) / settings.reach))
        return np.asarray(cost.sum(axis=1), dtype=np.float32)


class MppiWithGrid(SeeingPeer):
    """MPPI with the seen obstacles in its cost."""

    def __init__(self) -> None:
        settings = seeing_settings()
        law = GridMppiLaw(settings.mppi, law_data(load_config(MODEL)), settings.outline)
        super().__init__(law, settings.mppi.gains.lead, settings.mppi.wait)
        self._grid_law = law

    def _since_start(self, t: float, estimate: Estimate | None) -> float:
        progress = super()._since_start(t, estimate)
        self._grid_law.around = self._around
        return progress
