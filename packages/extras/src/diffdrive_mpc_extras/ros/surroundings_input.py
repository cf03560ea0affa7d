"""Surroundings of the robot from topics: a costmap, and moving objects.

`costmap` is a nav_msgs/OccupancyGrid. `obstacles` is a sensor_msgs/PointCloud2 with the fields x, y, radius, and vx, vy
where they move: of the types with a wheel it is the one that carries named numbers of many things in one block, and
RViz shows it; markers and polygons have no velocity. The size of both is checked first, they are read in the process
beside the loop, and are in the frame of control.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from time import monotonic
from typing import NamedTuple

import numpy as np
from nav_msgs.msg import OccupancyGrid as GridMessage
from pydantic import Field
from rclpy.qos import qos_profile_sensor_data
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import PointCloud2, PointField

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.table import plain_line
from diffdrive_mpc.mpc.controller import Controller
from diffdrive_mpc.mpc.ros.control_loop import RefusedError
from diffdrive_mpc.mpc.ros.conversions import (
    MAX_NAME_LENGTH,
    MessageError,
    check_frame,
    nanoseconds,
    planar_pose,
    too_long,
)
from diffdrive_mpc.mpc.ros.inbox import Inbox
from diffdrive_mpc.mpc.ros.node_part import NodePart, NodeTools
from diffdrive_mpc.mpc.ros.reference_input import preload
from diffdrive_mpc.mpc.ros.settings import PartSettings
from diffdrive_mpc.mpc.ros.side_process import SideProcess
from diffdrive_mpc.mpc.ros.topic_watch import TopicWatch
from diffdrive_mpc_extras.free_space import MovingDisc, OccupancyGrid, Surroundings
from diffdrive_mpc_extras.free_space.config import FreeSpace, free_space_of
from diffdrive_mpc_extras.free_space.feature import KeepClear
from diffdrive_mpc_extras.free_space.pieces import PreparedGrid, prepared_grid
from diffdrive_mpc_extras.free_space.surroundings import check_disc

_MOST_DISCS = 500
_OVERHEAD = 1024 + 2 * MAX_NAME_LENGTH
_OBSTACLES_BYTES = 64 * _MOST_DISCS + _OVERHEAD
_NUMBERS = {PointField.FLOAT32: "f4", PointField.FLOAT64: "f8"}
_NEEDED, _MOTION = ("x", "y", "radius"), ("vx", "vy")
_WARN_EVERY = 5.0
"""Between two warnings about one topic [s]: bad messages may come at any rate, and diagnostics have the last reason."""


class CostmapMessage(NamedTuple):
    """A costmap, its frame and its stamp [ns]."""

    grid: PreparedGrid
    frame: str
    stamp: int


class SeenDiscs(NamedTuple):
    """Things that may move, (n, 5) x, y, radius, vx, vy, with their frame and stamp [ns]."""

    discs: FloatArray
    frame: str
    stamp: int


def read_costmap(raw: bytes, settings: FreeSpace) -> CostmapMessage:
    """Convert a serialised OccupancyGrid to rectangles.

    Raises
    ------
    MessageError, SurroundingsError
        With the error in one line.
    """
    message: GridMessage = deserialize_message(raw, GridMessage)
    info = message.info
    cells = np.asarray(message.data, dtype=np.int8)
    if cells.size != info.width * info.height or not cells.size:
        raise MessageError(f"it has {cells.size} cells and says {info.width} x {info.height}")
    grid = OccupancyGrid(cells.reshape(info.height, info.width), round(info.resolution, 6), planar_pose(info.origin))
    prepared = prepared_grid(grid, settings)
    if len(prepared.boxes) > settings.max_pieces:
        count, most = len(prepared.boxes), settings.max_pieces
        raise MessageError(f"its occupied cells make {count} rectangles, free_space.max_pieces is {most}")
    return CostmapMessage(prepared, message.header.frame_id, nanoseconds(message.header.stamp))


def read_obstacles(raw: bytes) -> SeenDiscs:
    """Convert a serialised PointCloud2 to discs.

    Raises
    ------
    MessageError, SurroundingsError
        With the error in one line.
    """
    message: PointCloud2 = deserialize_message(raw, PointCloud2)
    count = message.width * message.height
    if count > _MOST_DISCS:
        raise MessageError(f"it has {count} points; give {_MOST_DISCS} at most, the nearest ones")
    if message.is_bigendian or message.point_step * count != len(message.data):
        raise MessageError("its data do not have the length that it states, or are big-endian")
    fields = {field.name: field for field in message.fields}
    missing = [name for name in _NEEDED if name not in fields]
    if missing:
        raise MessageError(f"it has no field {missing[0]}; give x, y, radius, and vx, vy of moving ones")
    columns = []
    for name in (*_NEEDED, *_MOTION):
        field = fields.get(name)
        if field is None:
            columns.append(np.zeros(count))
            continue
        kind = _NUMBERS.get(field.datatype)
        if kind is None or field.count != 1 or field.offset + int(kind[1]) > message.point_step:
            raise MessageError(f"its field {name} is no single float32 or float64 inside a point")
        layout = np.dtype(
            {"names": [name], "formats": [kind], "offsets": [field.offset], "itemsize": message.point_step}
        )
        columns.append(np.frombuffer(bytes(message.data), layout)[name].astype(float))
    discs = np.stack(columns, axis=1)
    if not np.isfinite(discs).all():
        raise MessageError("it holds a number that is not finite")
    for index, (x, y, radius, vx, vy) in enumerate(discs.tolist()):
        check_disc(MovingDisc(x, y, radius, vx, vy), f"disc {index}", timed=True)
    return SeenDiscs(discs, message.header.frame_id, nanoseconds(message.header.stamp))


class SurroundingsSettings(PartSettings):
    """Topics that show the surroundings."""

    use_costmap: bool = Field(
        False,
        description="keep clear of occupied cells of `costmap` (nav_msgs/OccupancyGrid), in the control frame; needs "
        "free_space.enabled [-]",
    )
    use_obstacles: bool = Field(
        False,
        description="keep clear of the discs on `obstacles` (sensor_msgs/PointCloud2 with x, y, radius, vx, vy) in the "
        "control frame; needs free_space.enabled [-]",
    )


class SurroundingsInput:
    """Combines the data of the topics, and gives them to the controller.

    Parameters
    ----------
    settings
        Settings of the topics.
    controller
        Controller that uses the surroundings.
    inbox
        Clock and frame of control.
    aside
        The process that reads messages.
    log
        Called with the reason why something was refused, once in some seconds for each topic.
    """

    def __init__(
        self,
        settings: SurroundingsSettings,
        controller: Controller,
        inbox: Inbox,
        aside: SideProcess,
        log: Callable[[str], None],
    ) -> None:
        self._controller, self._inbox, self._aside, self._log = controller, inbox, aside, log
        self._free_space = free_space_of(controller.config)
        self._keep_clear: KeepClear = controller.feature("free_space")
        self.costmap, self.obstacles = TopicWatch("costmap"), TopicWatch("obstacles")
        used = ((self.costmap, settings.use_costmap), (self.obstacles, settings.use_obstacles))
        self.topics = [topic for topic, uses in used if uses]
        self._warned: dict[str, float] = {}
        self.restart()

    def restart(self) -> None:
        """Forget what was seen: until everything has arrived the robot does not drive."""
        self._grid: PreparedGrid | None = None
        self._discs: FloatArray = np.zeros((0, 5))
        self._stamps: dict[str, float] = {}
        self._keep()
        for watch in self.topics:
            watch.restart()
        if self.topics:
            self._keep_clear.set_obstacles(Surroundings(time=self._inbox.now - 2.0 * self._free_space.max_age))

    @property
    def fault(self) -> str:
        """Name the missing or old topic; empty if there is none."""
        now, limit = self._inbox.now, self._free_space.max_age
        return "; ".join(filter(None, (watch.fault(now, limit) for watch in self.topics)))

    def take_costmap(self, raw: bytes) -> None:
        """Handle a serialised OccupancyGrid."""
        most = self._free_space.max_cells + _OVERHEAD
        if len(raw) > most:
            self._refuse(self.costmap, too_long(len(raw), most))
            return
        self._aside.submit(
            "costmap",
            read_costmap,
            (raw, self._free_space),
            self._see_grid,
            lambda why: self._refuse(self.costmap, why),
        )

    def take_obstacles(self, raw: bytes) -> None:
        """Handle a serialised PointCloud2."""
        if len(raw) > _OBSTACLES_BYTES:
            self._refuse(self.obstacles, too_long(len(raw), _OBSTACLES_BYTES))
            return
        self._aside.submit(
            "obstacles", read_obstacles, (raw,), self._see_discs, lambda why: self._refuse(self.obstacles, why)
        )

    def _see_grid(self, grid: CostmapMessage) -> None:
        if self._accept(self.costmap, grid.frame, grid.stamp):
            self._grid = grid.grid
            self._tell(self.costmap)

    def _see_discs(self, discs: SeenDiscs) -> None:
        if self._accept(self.obstacles, discs.frame, discs.stamp):
            self._discs = discs.discs
            self._tell(self.obstacles)

    def _accept(self, watch: TopicWatch, frame: str, stamp: int) -> bool:
        try:
            check_frame(frame, self._inbox.frame, "odom_frame, or map_frame with use_pose_topic")
            time = self._inbox.time_of(stamp)
            watch.accept(time, self._inbox.now, self._free_space.max_age)
        except MessageError as error:
            self._refuse(watch, str(error))
            return False
        self._stamps[watch.name] = time
        return True

    def _tell(self, watch: TopicWatch) -> None:
        """Let the controller see everything, as it was when the older of the two was."""
        if len(self._stamps) < len(self.topics):
            self._keep()
            return
        oldest = min(self._stamps.values())
        since = self._stamps.get(self.obstacles.name, oldest) - oldest
        discs = [MovingDisc(x - vx * since, y - vy * since, r, vx, vy) for x, y, r, vx, vy in self._discs.tolist()]
        try:
            self._keep_clear.set_obstacles(Surroundings(discs=discs, grid=self._grid, time=oldest))
        except ValueError as error:
            # Messages that cannot be used together must not affect later ones, nor count as fresh.
            watch.take_back(self._kept[2].get(watch.name))
            self._refuse(watch, str(error))
            self._grid, self._discs, self._stamps = self._kept[0], self._kept[1], dict(self._kept[2])
        else:
            self._keep()

    def _keep(self) -> None:
        self._kept = self._grid, self._discs, dict(self._stamps)

    def _refuse(self, watch: TopicWatch, reason: str) -> None:
        watch.refuse(plain_line(reason))
        now = monotonic()
        if now - self._warned.get(watch.name, -math.inf) >= _WARN_EVERY:
            self._warned[watch.name] = now
            self._log(watch.reason)


class FreeSpacePart(NodePart):
    """Costmap and obstacles for the controller; without fresh ones the robot does not drive."""

    schema = SurroundingsSettings

    surroundings: SurroundingsInput | None = None

    def configure(self, tools: NodeTools) -> None:
        """Subscribe to the topics in use."""
        settings = tools.part_settings(SurroundingsSettings)
        if not (settings.use_costmap or settings.use_obstacles):
            return
        if not free_space_of(tools.controller.config).enabled:
            raise RefusedError("use_costmap or use_obstacles is set: set free_space.enabled, too")
        warn = self.node.get_logger().warning
        surroundings = SurroundingsInput(settings, tools.controller, tools.inbox, tools.side_process, warn)
        self.surroundings, self.topics = surroundings, surroundings.topics
        if settings.use_costmap:
            self.subscribe_raw(GridMessage, "costmap", surroundings.take_costmap)
        if settings.use_obstacles:
            self.subscribe_raw(PointCloud2, "obstacles", surroundings.take_obstacles, qos_profile_sensor_data)
        tools.side_process.prepare(preload)

    def activate(self) -> None:
        """Forget the surroundings of the last activation."""
        if self.surroundings is not None:
            self.surroundings.restart()

    def tear_down(self) -> None:
        """Forget the surroundings."""
        self.surroundings, self.topics = None, ()
