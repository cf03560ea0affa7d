"""Doors whose types have no wheel: transforms, speed limits, the action follow_path; shut where types are missing."""

from __future__ import annotations

import math
from random import Random
from typing import Any

from geometry_msgs.msg import TransformStamped
from rclpy.node import Node

from diffdrive_mpc.mpc.ros.conversions import pose_message, stamped_pose_message, time_message
from fuzz import odd
from fuzz.live import references


def let_types_be_found() -> str:
    """Build the types, for this process and its children; returns why that cannot be, empty where it can."""
    from ros_types.build import add_types

    try:
        add_types()
    except (ImportError, ValueError, OSError, RuntimeError) as error:
        return f"{type(error).__name__}: {error}"
    return ""


class Doors:
    """Publishers and a client for them, on `node`; all of them None without types."""

    def __init__(self, node: Node) -> None:
        self.handles: list[Any] = []
        self.tf = self.speed = self.action = None
        self.results: list[int] = []
        try:
            from nav2_msgs.action import FollowPath
            from nav2_msgs.msg import SpeedLimit
            from rclpy.action import ActionClient
            from tf2_msgs.msg import TFMessage
        except ImportError:
            return
        self._tf_kind, self._speed_kind, self._goal_kind = TFMessage, SpeedLimit, FollowPath.Goal
        self.tf = node.create_publisher(TFMessage, "/tf", 100)
        self.speed = node.create_publisher(SpeedLimit, "speed_limit", 10)
        self.action = ActionClient(node, FollowPath, "follow_path")

    def transforms(self, now: int, pose: list[float]) -> Any:
        """map -> odom, where they were one when the robot began, and odom -> base_link."""
        message = self._tf_kind()
        for parent, child, at in (("map", "odom", [0.0, 0.0, 0.0]), ("odom", "base_link", pose)):
            one = TransformStamped(child_frame_id=child)
            one.header.stamp, one.header.frame_id = time_message(max(now, 0)), parent
            turned = pose_message(at)
            one.transform.translation.x, one.transform.translation.y = turned.position.x, turned.position.y
            one.transform.rotation = turned.orientation
            message.transforms.append(one)
        return message

    def limit_speed(self, random: Random, value: float, percentage: bool) -> None:
        """A speed limit, or rubbish."""
        if self.speed is None:
            return
        message = self._speed_kind(speed_limit=float(value), percentage=percentage)
        self.speed.publish(references.spoilt(message, random) if random.random() < 0.1 else message)

    def send_goal(self, table: list[references.Row], frame: str, now: int, words: str) -> None:
        """A goal for follow_path; what becomes of it is noted when it comes."""
        if self.action is None or not self.action.server_is_ready():
            return
        goal = self._goal_kind(controller_id=words)
        goal.path.header.frame_id, goal.path.header.stamp = frame, time_message(max(now, 0))
        goal.path.poses = [stamped_pose_message((x, y, theta), max(now, 0), frame) for _, x, y, theta in table]
        self.action.send_goal_async(goal).add_done_callback(self._answered)

    def _answered(self, future: Any) -> None:
        handle = future.result()
        if handle is not None and handle.accepted:
            self.handles = [*self.handles[-4:], handle]
            handle.get_result_async().add_done_callback(lambda over: self.results.append(int(over.result().status)))

    def cancel(self) -> None:
        """Cancel what was sent lately, whether it still drives or not."""
        for handle in self.handles:
            handle.cancel_goal_async()


def tamper_transforms(how: str, random: Random, message: Any) -> list[Any]:
    """What is sent instead of honest transforms."""
    first = message.transforms[0]
    if how == "lost":
        return []
    if how == "not a number":
        message.transforms[1].transform.translation.x = math.nan
    elif how == "loop":
        first.header.frame_id, first.child_frame_id = "base_link", "map"
    elif how == "self":
        first.child_frame_id = first.header.frame_id
    elif how == "two parents":
        first.child_frame_id = "base_link"
    elif how == "many":
        for i in range(200):
            one = TransformStamped(child_frame_id=f"frame_{random.randrange(10**6)}_{i}")
            one.header.stamp, one.header.frame_id = first.header.stamp, "map"
            one.transform.rotation.w = 1.0
            message.transforms.append(one)
    elif how == "jump":
        first.transform.translation.x = random.choice((0.05, 0.5, 5.0, 1e9))
    elif how == "no orientation":
        message.transforms[1].transform.rotation.w = message.transforms[1].transform.rotation.z = 0.0
    elif how == "ahead":
        for one in message.transforms:
            one.header.stamp.sec = min(one.header.stamp.sec + 1000, 2**31 - 1)
    elif how == "words":
        first.child_frame_id = random.choice(odd.WORDS).replace("\x00", "").encode("utf-8", "replace").decode()
    elif how == "garbage":
        return [references.spoilt(message, random)]
    return [message]


TAMPERED_TRANSFORMS = (
    "lost",
    "not a number",
    "loop",
    "self",
    "two parents",
    "many",
    "jump",
    "no orientation",
    "ahead",
    "words",
    "garbage",
    "",
)
