"""Part of the node that offers the action `follow_path`."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.mpc.ros.control_loop import LoopTick
from diffdrive_mpc.mpc.ros.follow_goal import Following, FrameError, plan_for_robot
from diffdrive_mpc.mpc.ros.inbox import Inbox
from diffdrive_mpc.mpc.ros.node_part import NodePart, NodeTools
from diffdrive_mpc.mpc.ros.reference_input import preload
from diffdrive_mpc.mpc.ros.transforms.buffer import TransformError
from diffdrive_mpc.mpc.ros.transforms.frames import moved_poses
from diffdrive_mpc.mpc.trajectories.planned.planned_path import PlannedPath

if TYPE_CHECKING:
    from diffdrive_mpc.mpc.ros.follow_path import FollowPathServer


class FollowPathPart(NodePart):
    """Action server of the node, and the goals of the current activation."""

    server: FollowPathServer | None = None
    _following: Following | None = None

    def configure(self, tools: NodeTools) -> None:
        """Start the action server if it is enabled and its type is installed."""
        if not tools.settings.follow_path:
            return
        try:
            from diffdrive_mpc.mpc.ros.follow_path import FollowPathServer  # noqa: PLC0415 - needs nav2_msgs
        except ImportError as error:
            self.node.get_logger().info(f"no action follow_path: {error} (it needs nav2_msgs)")
            return
        self.server = FollowPathServer(self.node, tools.settings)

    def activate(self) -> None:
        """Accept goals until the deactivation."""
        if self.server is None:
            return
        loop, tools = self.require_active()
        controller, side_process = tools.controller, tools.side_process
        checks = tuple(check for part in self.node.parts.values() if (check := part.path_check()) is not None)

        def plan_path(
            arguments: tuple[object, ...], done: Callable[[PlannedPath | None], None], failed: Callable[[str], None]
        ) -> None:
            side_process.submit("follow_path", plan_for_robot, (*arguments, checks), done, failed)

        side_process.prepare(preload)
        self._following = Following(
            loop,
            tools.settings,
            lambda: controller.config,
            lambda: controller.model.dc_gain,
            plan_path,
            lambda poses, frame, stamp: in_control_frame(tools.inbox, poses, frame, stamp),
        )
        self.server.open(self._following)

    def tick(self, tick: LoopTick) -> None:
        """Update the current goal."""
        if self._following is not None:
            self._following.update(tick)

    def deactivate(self) -> None:
        """Abort all goals, and refuse new goals."""
        if self.server is not None:
            self.server.end_goals("the node was deactivated")
        self._following = None

    def tear_down(self) -> None:
        """Stop the action server."""
        if self.server is not None:
            self.server.close()
            self.server = None


def in_control_frame(inbox: Inbox, poses: FloatArray, frame: str, stamp: int) -> FloatArray:
    """Transform poses (n, 3) from `frame` to the control frame with the current transforms.

    The result does not move with `frame`, since a planner sends a new path after a correction of the localisation.

    Raises
    ------
    FrameError
        If the transform is unknown.
    """
    if inbox.frames is None:
        if frame != inbox.frame:
            raise FrameError(f"the path is in '{frame}', control in '{inbox.frame}': plan in that frame, or set use_tf")
        return poses
    try:
        placement = inbox.frames.placement(frame, stamp)
        return poses if placement is None else moved_poses(poses, placement.motion())
    except TransformError as error:
        raise FrameError(str(error)) from error
