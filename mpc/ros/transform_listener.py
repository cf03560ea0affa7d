"""Hears /tf and /tf_static."""

from __future__ import annotations

from typing import Any

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.subscription import Subscription

from diffdrive_mpc.mpc.ros.conversions import message_type, nanoseconds, subscribe_bounded
from diffdrive_mpc.mpc.ros.transforms.frames import Frames
from diffdrive_mpc.mpc.ros.transforms.rigid import Rigid

# As many messages wait as for tf2's own listener.
_DYNAMIC = QoSProfile(depth=100)
_STATIC = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
MOST_BYTES = 200_000
"""Maximum size of one message, some hundred frames, which take some milliseconds to read."""


def listen(node: Node, frames: Frames, *, moving: bool = True) -> list[Subscription]:
    """Subscribe `node` to both topics, for `frames`; without `moving` to what never moves.

    Raises
    ------
    ValueError
        If the type of their messages is not installed.
    """
    kind = message_type("tf2_msgs", "TFMessage")
    if kind is None:
        raise ValueError("transforms are to be used (pose_source: tf, or use_tf), but tf2_msgs is not installed")

    def taking(*, static: bool) -> Any:  # noqa: ANN401 - a callback
        def take(message: Any) -> None:  # noqa: ANN401 - ROS messages have no types to check
            for each in message.transforms:
                translation, turn = each.transform.translation, each.transform.rotation
                rigid = Rigid(translation.x, translation.y, translation.z, turn.x, turn.y, turn.z, turn.w)
                stamp = nanoseconds(each.header.stamp)
                frames.take(each.header.frame_id, each.child_frame_id, stamp, rigid, static=static)

        return take

    return [
        subscribe_bounded(node, kind, topic, taking(static=static), qos, refuse=frames.refuse, most=MOST_BYTES)
        for topic, qos, static in (("/tf_static", _STATIC, True), ("/tf", _DYNAMIC, False))[: 1 + moving]
    ]
