"""Topics of a ROS 2 bag as rows of numbers, read without running anything that the bag brings along."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.record import BoolArray

if TYPE_CHECKING:
    from rosbags.rosbag2 import Reader

Reading = tuple[float, ...]


def _twist(message: Any) -> Reading:  # noqa: ANN401 - the types are made by rosbags
    return float(message.linear.x), float(message.angular.z)


def _pose(message: Any) -> Reading:  # noqa: ANN401
    position, q = message.position, message.orientation
    # Yaw of a unit quaternion, z-y-x Euler angles.
    yaw = math.atan2(2.0 * (q.w * q.z + q.x * q.y), 1.0 - 2.0 * (q.y**2 + q.z**2))
    return float(position.x), float(position.y), yaw


COMMANDS: dict[str, Callable[[Any], Reading]] = {
    "geometry_msgs/msg/Twist": _twist,
    "geometry_msgs/msg/TwistStamped": lambda message: _twist(message.twist),
}
"""v [m/s], omega [rad/s] by message type."""

ODOMETRY: dict[str, Callable[[Any], Reading]] = {
    "nav_msgs/msg/Odometry": lambda message: _twist(message.twist.twist),
}
"""v [m/s], omega [rad/s]; an odometry's pose is its own sum and says nothing more."""

IMU: dict[str, Callable[[Any], Reading]] = {
    "sensor_msgs/msg/Imu": lambda message: (float(message.angular_velocity.z),),
}
"""Yaw rate [rad/s]."""

POSES: dict[str, Callable[[Any], Reading]] = {
    "geometry_msgs/msg/PoseStamped": lambda message: _pose(message.pose),
    "geometry_msgs/msg/PoseWithCovarianceStamped": lambda message: _pose(message.pose.pose),
    "nav_msgs/msg/Odometry": lambda message: _pose(message.pose.pose),
}
"""x [m], y [m], theta [rad]."""


def stamp(message: Any) -> int:  # noqa: ANN401
    """Time in a message's header [ns]; 0 where it has none or nobody set it."""
    header = getattr(message, "header", None)
    return 0 if header is None else int(header.stamp.sec) * 10**9 + int(header.stamp.nanosec)


Decoders = Mapping[str, Callable[[Any], Reading]]


@dataclass(frozen=True)
class TopicRows:
    """The n messages of one topic, in the order of their receipt.

    Attributes
    ----------
    topic
        Name.
    received, stamped
        (n,) times of receipt and of the messages' headers [ns]; 0 where a header has none.
    value
        (n, width), not checked for finiteness.
    """

    topic: str
    received: FloatArray
    stamped: FloatArray
    value: FloatArray

    @property
    def has_stamps(self) -> BoolArray:
        """Whether every message carries a stamp."""
        return np.asarray((self.stamped > 0).all())


@contextmanager
def opened(path: Path) -> Iterator[Reader]:
    """Open a rosbag2: its folder, or one .mcap or .db3 file.

    Raises
    ------
    ConfigError
        If it cannot be read, here or while the context reads on.
    """
    from rosbags.rosbag2 import Reader  # noqa: PLC0415 - only those who read bags need the library

    try:
        with Reader(path) as reader:
            yield reader
    except ConfigError:
        raise
    except Exception as error:  # a damaged file fails in as many ways as there are bytes
        reason = " ".join(str(error).split()) or type(error).__name__
        raise ConfigError(
            f"{path}: cannot be read as a ROS 2 bag ({reason}); is it complete? `ros2 bag reindex` may save it"
        ) from error


def read_topic(reader: Reader, path: Path, topic: str, decoders: Decoders) -> TopicRows:
    """Read all messages of one topic.

    Message types are the library's own, never the definitions inside the bag, from which it would generate code.

    Raises
    ------
    ConfigError
        If the bag has no such topic, the topic has another type, or it holds no message.
    ValueError
        If messages have been lost.
    """
    from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415

    connections = [connection for connection in reader.connections if connection.topic == topic]
    if not connections:
        there = ", ".join(sorted({f"{known.topic} ({known.msgtype})" for known in reader.connections})) or "none"
        raise ConfigError(f"{path}: no topic '{topic}'; name it under 'topics' in the mapping; the bag has {there}")
    kinds = sorted({connection.msgtype for connection in connections})
    if len(kinds) > 1 or kinds[0] not in decoders:
        raise ConfigError(f"{path}: topic '{topic}' is of type {', '.join(kinds)}; expected {' or '.join(decoders)}")
    store, decode = get_typestore(Stores.ROS2_JAZZY), decoders[kinds[0]]
    received, stamped, values = [], [], []
    for _, timestamp, data in reader.messages(connections=connections):
        message = store.deserialize_cdr(data, kinds[0])
        received.append(timestamp)
        stamped.append(stamp(message))
        values.append(decode(message))
    promised = sum(connection.msgcount for connection in connections)
    if len(values) < promised:  # the library skips what it cannot make out in a damaged file
        raise ValueError(f"topic '{topic}' holds {len(values)} of {promised} messages")
    if not values:
        raise ConfigError(f"{path}: topic '{topic}' holds no message")
    return TopicRows(topic, np.array(received), np.array(stamped), np.array(values))
