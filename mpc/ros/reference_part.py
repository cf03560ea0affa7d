"""Parts of the node that receive references and speed limits from topics."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import Path
from trajectory_msgs.msg import MultiDOFJointTrajectory

from diffdrive_mpc.mpc.config.schema import Limits
from diffdrive_mpc.mpc.ros.control_loop import ControlLoop, RefusedError
from diffdrive_mpc.mpc.ros.conversions import check_frame, message_type, too_long
from diffdrive_mpc.mpc.ros.node_part import NodePart, NodeTools
from diffdrive_mpc.mpc.ros.reference_input import (
    MAX_BYTES,
    MAX_TRAJECTORY_BYTES,
    FramedReference,
    SpeedLimit,
    preload,
    read_path,
    read_speed_limit,
    read_timed_trajectory,
    read_trajectory,
    timed_trajectory_type,
)

_TOPICS = "set_path", "set_trajectory", "set_timed_trajectory"


class ReferencePart(NodePart):
    """Receiver of references on topics, which the side process converts and the control loop tracks."""

    def configure(self, _tools: NodeTools) -> None:
        """Subscribe to the topics whose message types are installed."""
        self.subscribe_raw(Path, _TOPICS[0], self._callback(read_path))
        self.subscribe_raw(MultiDOFJointTrajectory, _TOPICS[1], self._callback(read_trajectory))
        timed_type = timed_trajectory_type()
        if timed_type is not None:
            self.subscribe_raw(timed_type, _TOPICS[2], self._callback(read_timed_trajectory, MAX_TRAJECTORY_BYTES))

    def after_diagnostics(self, _message: DiagnosticArray, _time: int) -> None:
        """Start the side process as soon as a node publishes references."""
        if self.loop is not None and any(self.node.count_publishers(topic) for topic in _TOPICS):
            self.require_active()[1].side_process.prepare(preload)

    def _callback(
        self, read_reference: Callable[[bytes, Limits], FramedReference], max_bytes: int = MAX_BYTES
    ) -> Callable[[bytes], None]:
        """Return a callback that converts references of at most `max_bytes` in the side process."""

        def receive(raw: bytes) -> None:
            try:
                loop, tools = self.require_active()
            except RefusedError as error:
                self._refuse(str(error))
                return
            if len(raw) > max_bytes:
                self._refuse(too_long(len(raw), max_bytes))
                return
            arguments = raw, tools.controller.config.limits
            tools.side_process.submit(
                "reference", read_reference, arguments, lambda framed: self._set_reference(loop, framed), self._refuse
            )

        return receive

    def _refuse(self, reason: str) -> None:
        message = f"reference refused: {reason}"
        if self.loop is not None:
            self.loop.refusal = message
        self.node.get_logger().error(message)

    def _set_reference(self, loop: ControlLoop, framed: FramedReference) -> None:
        """Pass a reference to `loop`, which was active at the arrival of the message; log the reason of a rejection."""
        try:
            if loop is not self.loop:
                raise RefusedError("the node was deactivated during its conversion")
            inbox = loop.inbox
            if inbox.frames is None:
                parameter = "odom_frame, or map_frame with use_pose_topic; with use_tf, any frame on /tf is allowed"
                check_frame(framed.frame, inbox.frame, parameter)
                loop.set_reference(framed.reference)
            else:
                loop.set_reference(framed.reference, inbox.frames.placement(framed.frame, framed.stamp))
        except ValueError as error:
            self._refuse(str(error))
        else:
            self.node.get_logger().info(f"reference accepted: {framed.reference.duration:.1f} s")


class SpeedLimitPart(NodePart):
    """Receiver of speed limits on a topic; a limit persists across activations."""

    _limit: SpeedLimit | None = None
    _refusal = ""

    @property
    def fault(self) -> str:
        """Reason why the last limit was refused; empty if it was accepted."""
        return self._refusal

    def configure(self, tools: NodeTools) -> None:
        """Subscribe to the topic if its message type is installed."""
        if not tools.settings.use_speed_limit:
            return
        kind = message_type("nav2_msgs", "SpeedLimit")
        if kind is None:
            self.node.get_logger().info("no subscription to speed_limit: nav2_msgs is not installed")
            return
        self.subscribe(kind, "speed_limit", self._receive, 10, self._refuse)

    def activate(self) -> None:
        """Apply the last limit."""
        self.change_limits()

    def change_limits(self) -> None:
        """Apply the limit to the controller; a percentage is relative to the current maximum speed."""
        if self.tools is None or self._limit is None:
            return
        controller = self.tools.controller
        common, *sides = (self.node.get_parameter(f"limits.v{side}").value for side in ("", ".forward", ".reverse"))
        limit = self._limit.speed(max(side or common for side in sides))
        if limit != controller.speed_limit:
            controller.limit_speed(limit)
            self.node.get_logger().info("speed limit removed" if limit is None else f"speed limit {limit:.3g} m/s")

    def _receive(self, message: Any) -> None:  # noqa: ANN401 - ROS messages have no types to check
        try:
            limit = read_speed_limit(message)
        except ValueError as error:
            self._refuse(str(error))
            return
        self._refusal = ""
        if limit != self._limit:
            self._limit = limit
            self.change_limits()

    def _refuse(self, reason: str) -> None:
        self._refusal = f"speed limit refused, the last limit stays: {reason}"
        self.node.get_logger().error(self._refusal)
