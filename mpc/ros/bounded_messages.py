"""Subscriptions that look at the size of a message before it is read: a long one would take longer than a tick."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message
from rclpy.subscription import Subscription

LONGEST_NAME = 255
"""Characters of a frame's name at most: what is longer is none."""
_HEADER = 4 + 8 + 4 + LONGEST_NAME + 1 + 8
"""Bytes of a serialised header at most: stamp, name with its length and end, room to align."""
SENSOR_BYTES = 2048
"""Bytes of a message of odometry, gyro or pose at most: their numbers take less than 800, two names the rest."""
BATTERY_BYTES = 8192
"""Bytes of a battery's state at most: two numbers for each of some hundreds of cells, and three names."""
POSE_BYTES = _HEADER + 7 * 8
"""Bytes of a pose with its header at most."""


def path_bytes(poses: int) -> int:
    """Bytes that a path of so many poses takes at most, or a trajectory with velocities and accelerations."""
    return _HEADER + poses * POSE_BYTES


def too_long(size: int, most: int) -> str:
    """Why a message of `size` bytes is not read."""
    return f"it has {size} bytes, and none of its kind that can be used has more than {most}"


def subscribe_bounded(
    node: Node,
    kind: type[Any],
    topic: str,
    take: Callable[[Any], None],
    qos: QoSProfile | int,
    *,
    refuse: Callable[[str], None],
    most: int = SENSOR_BYTES,
) -> Subscription:
    """Subscribe to `topic`; messages of more than `most` bytes are not read.

    Parameters
    ----------
    node, kind, topic, qos
        As for `create_subscription`.
    take
        Called with each message.
    refuse
        Called with the reason instead, where one is too long or cannot be read.
    most
        Bytes of a serialised message at most.
    """

    def look(raw: bytes) -> None:
        if len(raw) > most:
            refuse(too_long(len(raw), most))
            return
        try:
            message = deserialize_message(raw, kind)
        except Exception as error:  # rmw has no type of error for it
            refuse(f"it cannot be read ({' '.join(str(error).split())})")
            return
        take(message)

    return node.create_subscription(kind, topic, look, qos, raw=True)
