"""Surroundings of the robot from topics: a costmap and moving obstacles, both in the control frame.

`costmap` is a nav_msgs/OccupancyGrid. `obstacles` is a sensor_msgs/PointCloud2 with the fields x, y, radius, and vx, vy
for moving obstacles. PointCloud2 carries named numbers of many obstacles in one block, and RViz displays it; markers
and polygons have no velocity. The node checks the size of a message first, and the side process reads the message.
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

_MAX_DISCS = 500
_OVERHEAD = 1024 + 2 * MAX_NAME_LENGTH
_OBSTACLES_BYTES = 64 * _MAX_DISCS + _OVERHEAD
_NUMBER_FORMATS = {PointField.FLOAT32: "f4", PointField.FLOAT64: "f8"}
_REQUIRED_FIELDS, _VELOCITY_FIELDS = ("x", "y", "radius"), ("vx", "vy")
_WARNING_PERIOD = 5.0
"""Minimum time between two warnings about one topic [s]; diagnostics contain the reason of every refusal."""


class CostmapMessage(NamedTuple):
    """Costmap with its frame and its stamp [ns]."""

    grid: PreparedGrid
    frame: str
    stamp: int


class ObstaclesMessage(NamedTuple):
    """Discs (n, 5) x, y, radius [m], vx, vy [m/s] with their frame and stamp [ns]."""

    discs: FloatArray
    frame: str
    stamp: int


def read_costmap(raw: bytes, settings: FreeSpace) -> CostmapMessage:
    """Convert a serialised OccupancyGrid to rectangles.

    Raises
    ------
    MessageError, SurroundingsError
        If the message is invalid; the text is one line.
    """
    message: GridMessage = deserialize_message(raw, GridMessage)
    info = message.info
    cells = np.asarray(message.data, dtype=np.int8)
    if cells.size != info.width * info.height or not cells.size:
        raise MessageError(f"it has {cells.size} cells, but its size is {info.width} x {info.height}")
    grid = OccupancyGrid(cells.reshape(info.height, info.width), round(info.resolution, 6), planar_pose(info.origin))
    prepared = prepared_grid(grid, settings)
    if len(prepared.boxes) > settings.max_pieces:
        count, limit = len(prepared.boxes), settings.max_pieces
        raise MessageError(f"its occupied cells make {count} rectangles, free_space.max_pieces is {limit}")
    return CostmapMessage(prepared, message.header.frame_id, nanoseconds(message.header.stamp))


def read_obstacles(raw: bytes) -> ObstaclesMessage:
    """Convert a serialised PointCloud2 to discs.

    Raises
    ------
    MessageError, SurroundingsError
        If the message is invalid; the text is one line.
    """
    message: PointCloud2 = deserialize_message(raw, PointCloud2)
    count = message.width * message.height
    if count > _MAX_DISCS:
        raise MessageError(f"it has {count} points; send at most the nearest {_MAX_DISCS}")
    if message.is_bigendian or message.point_step * count != len(message.data):
        raise MessageError("the length of its data differs from point_step times points, or they are big-endian")
    fields = {field.name: field for field in message.fields}
    missing = [name for name in _REQUIRED_FIELDS if name not in fields]
    if missing:
        raise MessageError(f"it has no field {missing[0]}; send x, y, radius, and vx, vy for moving obstacles")
    columns = []
    for name in (*_REQUIRED_FIELDS, *_VELOCITY_FIELDS):
        field = fields.get(name)
        if field is None:
            columns.append(np.zeros(count))
            continue
        number = _NUMBER_FORMATS.get(field.datatype)
        if number is None or field.count != 1 or field.offset + int(number[1]) > message.point_step:
            raise MessageError(f"its field {name} is not a single float32 or float64 inside a point")
        layout = np.dtype(
            {"names": [name], "formats": [number], "offsets": [field.offset], "itemsize": message.point_step}
        )
        columns.append(np.frombuffer(bytes(message.data), layout)[name].astype(float))
    discs = np.stack(columns, axis=1)
    if not np.isfinite(discs).all():
        raise MessageError("it contains a number that is not finite")
    for index, (x, y, radius, vx, vy) in enumerate(discs.tolist()):
        check_disc(MovingDisc(x, y, radius, vx, vy), f"disc {index}", timed=True)
    return ObstaclesMessage(discs, message.header.frame_id, nanoseconds(message.header.stamp))


class SurroundingsSettings(PartSettings):
    """Settings of the topics with the surroundings."""

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
    """Input that combines the data of the topics and passes them to the controller.

    Parameters
    ----------
    settings
        Settings of the topics.
    controller
        Controller that uses the surroundings.
    inbox
        Clock and frame of control.
    side_process
        Process that reads messages.
    log
        Function that logs the reason of a refusal; called at most once in some seconds for each topic.
    """

    def __init__(
        self,
        settings: SurroundingsSettings,
        controller: Controller,
        inbox: Inbox,
        side_process: SideProcess,
        log: Callable[[str], None],
    ) -> None:
        self._controller, self._inbox, self._side_process, self._log = controller, inbox, side_process, log
        self._free_space = free_space_of(controller.config)
        self._keep_clear: KeepClear = controller.feature("free_space")
        self.costmap, self.obstacles = TopicWatch("costmap"), TopicWatch("obstacles")
        uses = ((self.costmap, settings.use_costmap), (self.obstacles, settings.use_obstacles))
        self.topics = [topic for topic, is_used in uses if is_used]
        self._warning_times: dict[str, float] = {}
        self.restart()

    def restart(self) -> None:
        """Discard all data; the robot does not drive until every topic has a new message."""
        self._grid: PreparedGrid | None = None
        self._discs: FloatArray = np.zeros((0, 5))
        self._stamps: dict[str, float] = {}
        self._save()
        for watch in self.topics:
            watch.restart()
        if self.topics:
            self._keep_clear.set_obstacles(Surroundings(time=self._inbox.now - 2.0 * self._free_space.max_age))

    @property
    def fault(self) -> str:
        """Description of missing or old topics; empty without a fault."""
        now, limit = self._inbox.now, self._free_space.max_age
        return "; ".join(filter(None, (watch.fault(now, limit) for watch in self.topics)))

    def take_costmap(self, raw: bytes) -> None:
        """Handle a serialised OccupancyGrid."""
        limit = self._free_space.max_cells + _OVERHEAD
        if len(raw) > limit:
            self._refuse(self.costmap, too_long(len(raw), limit))
            return
        self._side_process.submit(
            "costmap",
            read_costmap,
            (raw, self._free_space),
            self._use_costmap,
            lambda text: self._refuse(self.costmap, text),
        )

    def take_obstacles(self, raw: bytes) -> None:
        """Handle a serialised PointCloud2."""
        if len(raw) > _OBSTACLES_BYTES:
            self._refuse(self.obstacles, too_long(len(raw), _OBSTACLES_BYTES))
            return
        self._side_process.submit(
            "obstacles", read_obstacles, (raw,), self._use_obstacles, lambda text: self._refuse(self.obstacles, text)
        )

    def _use_costmap(self, message: CostmapMessage) -> None:
        if self._accept(self.costmap, message.frame, message.stamp):
            self._grid = message.grid
            self._update_controller(self.costmap)

    def _use_obstacles(self, message: ObstaclesMessage) -> None:
        if self._accept(self.obstacles, message.frame, message.stamp):
            self._discs = message.discs
            self._update_controller(self.obstacles)

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

    def _update_controller(self, watch: TopicWatch) -> None:
        """Pass the surroundings to the controller, for the time of the older of the two messages."""
        if len(self._stamps) < len(self.topics):
            self._save()
            return
        oldest = min(self._stamps.values())
        age = self._stamps.get(self.obstacles.name, oldest) - oldest
        discs = [MovingDisc(x - vx * age, y - vy * age, r, vx, vy) for x, y, r, vx, vy in self._discs.tolist()]
        try:
            self._keep_clear.set_obstacles(Surroundings(discs=discs, grid=self._grid, time=oldest))
        except ValueError as error:
            # Restore the last valid combination: the refused message must not count as fresh or affect later messages.
            watch.undo_accept(self._saved[2].get(watch.name))
            self._refuse(watch, str(error))
            self._grid, self._discs, self._stamps = self._saved[0], self._saved[1], dict(self._saved[2])
        else:
            self._save()

    def _save(self) -> None:
        self._saved = self._grid, self._discs, dict(self._stamps)

    def _refuse(self, watch: TopicWatch, reason: str) -> None:
        watch.refuse(plain_line(reason))
        now = monotonic()
        if now - self._warning_times.get(watch.name, -math.inf) >= _WARNING_PERIOD:
            self._warning_times[watch.name] = now
            self._log(watch.reason)


class FreeSpacePart(NodePart):
    """Node part with costmap and obstacles for the controller; the robot drives only with fresh messages."""

    schema = SurroundingsSettings

    surroundings: SurroundingsInput | None = None

    def configure(self, tools: NodeTools) -> None:
        """Subscribe to the topics in use."""
        settings = tools.part_settings(SurroundingsSettings)
        if not (settings.use_costmap or settings.use_obstacles):
            return
        if not free_space_of(tools.controller.config).enabled:
            raise RefusedError("use_costmap or use_obstacles is set; also set free_space.enabled")
        warn = self.node.get_logger().warning
        surroundings = SurroundingsInput(settings, tools.controller, tools.inbox, tools.side_process, warn)
        self.surroundings, self.topics = surroundings, surroundings.topics
        if settings.use_costmap:
            self.subscribe_raw(GridMessage, "costmap", surroundings.take_costmap)
        if settings.use_obstacles:
            self.subscribe_raw(PointCloud2, "obstacles", surroundings.take_obstacles, qos_profile_sensor_data)
        tools.side_process.prepare(preload)

    def activate(self) -> None:
        """Discard the surroundings of the previous activation."""
        if self.surroundings is not None:
            self.surroundings.restart()

    def tear_down(self) -> None:
        """Discard the surroundings."""
        self.surroundings, self.topics = None, ()
