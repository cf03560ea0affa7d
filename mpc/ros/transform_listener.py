"""Subscriptions to /tf and /tf_static."""

from __future__ import annotations

from typing import Any

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.subscription import Subscription

from diffdrive_mpc.mpc.ros.conversions import message_type, nanoseconds, subscribe_bounded
from diffdrive_mpc.mpc.ros.transforms.frames import Frames
from diffdrive_mpc.mpc.ros.transforms.rigid import Rigid

# The queue depth is equal to that of the tf2 listener.
_DYNAMIC = QoSProfile(depth=100)
_STATIC = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
MAX_BYTES = 200_000
"""Maximum size of a message [bytes], for several hundred frames, whose conversion takes several milliseconds."""


def listen(node: Node, frames: Frames, *, moving: bool = True) -> list[Subscription]:
    """Subscribe `node` to /tf_static and, if `moving` is True, to /tf; the transforms are stored in `frames`.

    Raises
    ------
    ValueError
        If the message type is not installed.
    """
    kind = message_type("tf2_msgs", "TFMessage")
    if kind is None:
        raise ValueError("pose_source tf and use_tf require tf2_msgs, which is not installed")

    def callback(*, static: bool) -> Any:  # noqa: ANN401 - a callback
        def receive(message: Any) -> None:  # noqa: ANN401 - ROS messages have no types to check
            for entry in message.transforms:
                translation, rotation = entry.transform.translation, entry.transform.rotation
                quaternion = rotation.x, rotation.y, rotation.z, rotation.w
                rigid = Rigid(translation.x, translation.y, translation.z, *quaternion)
                stamp = nanoseconds(entry.header.stamp)
                frames.store(entry.header.frame_id, entry.child_frame_id, stamp, rigid, static=static)

        return receive

    return [
        subscribe_bounded(node, kind, topic, callback(static=static), qos, refuse=frames.refuse, max_bytes=MAX_BYTES)
        for topic, qos, static in (("/tf_static", _STATIC, True), ("/tf", _DYNAMIC, False))[: 1 + moving]
    ]
