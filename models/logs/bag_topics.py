"""Conversion of topics of a ROS 2 bag to arrays of numbers. No code from a bag is executed."""

from __future__ import annotations

import math
from array import array
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import reduce
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from diffdrive_mpc.models.checked_yaml import ConfigError, mistakes
from diffdrive_mpc.models.input_file import MEGABYTE, read_input
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.bag_reader import Bag, Connection
from diffdrive_mpc.models.logs.mapping import MotorTopic, Topic, draft_command
from diffdrive_mpc.models.logs.record import BoolArray

Reading = tuple[float, ...]


def _twist(message: Any) -> Reading:  # noqa: ANN401 - rosbags creates the types
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

ODOMETRY: dict[str, Callable[[Any], Reading]] = {"nav_msgs/msg/Odometry": lambda message: _twist(message.twist.twist)}
"""v [m/s], omega [rad/s]. The pose of the odometry is the integral of its twist and adds no information."""

IMU: dict[str, Callable[[Any], Reading]] = {"sensor_msgs/msg/Imu": lambda message: (float(message.angular_velocity.z),)}
"""Yaw rate [rad/s]."""

POSES: dict[str, Callable[[Any], Reading]] = {
    "geometry_msgs/msg/PoseStamped": lambda message: _pose(message.pose),
    "geometry_msgs/msg/PoseWithCovarianceStamped": lambda message: _pose(message.pose.pose),
    "nav_msgs/msg/Odometry": lambda message: _pose(message.pose.pose),
    "geometry_msgs/msg/PointStamped": lambda message: (float(message.point.x), float(message.point.y)),
}
"""x [m], y [m], and theta [rad] if the message has it."""


BATTERIES: dict[str, Callable[[Any], Reading]] = {
    # REP 147: a discharging current is negative; in a record the output of the battery is positive.
    "sensor_msgs/msg/BatteryState": lambda message: (float(message.voltage), -float(message.current))
}
"""Voltage [V], output current of the battery [A]."""

_NUMBER: Callable[[Any], Reading] = lambda message: (float(message.data),)  # noqa: E731


def motor_readers(topic: MotorTopic) -> dict[str, Callable[[Any], Reading]]:
    """Return decoders of the motor currents of one side for message types that need no `fields`."""
    joints = topic.joints
    if joints is None:
        return {"std_msgs/msg/Float32": _NUMBER, "std_msgs/msg/Float64": _NUMBER}

    def efforts(message: Any) -> Reading:  # noqa: ANN401
        effort_by_joint = dict(zip(message.name, message.effort, strict=False))
        # Missing joints yield NaN; messages that are not finite are left out later.
        return tuple(float(effort_by_joint.get(joint, math.nan)) for joint in joints)

    return {"sensor_msgs/msg/JointState": efforts}


def stamp(message: Any) -> int:  # noqa: ANN401
    """Return the time in a message's header [ns]; 0 if it is missing or unset."""
    header = getattr(message, "header", None)
    return 0 if header is None else int(header.stamp.sec) * 10**9 + int(header.stamp.nanosec)


Decoders = Mapping[str, Callable[[Any], Reading]]


@dataclass(frozen=True)
class TopicRows:
    """The n messages of one topic, in order of receipt.

    Attributes
    ----------
    topic
        Name.
    received, stamped
        (n,) times of receipt and of the message headers [ns]; 0 if a header has no time.
    value
        (n, width) values, not checked for finiteness.
    stride
        n if every n-th message was read; 1 if all messages were read.
    kind
        Message type.
    """

    topic: str
    received: FloatArray
    stamped: FloatArray
    value: FloatArray
    stride: int = 1
    kind: str = ""

    @property
    def has_stamps(self) -> BoolArray:
        """True if every message carries a stamp."""
        return np.asarray((self.stamped > 0).all())


@contextmanager
def open_bag(path: Path) -> Iterator[Bag]:
    """Open a rosbag2 by its folder or by one .mcap or .db3 file.

    Raises
    ------
    ConfigError
        If the bag cannot be read, also inside the context.
    """
    try:
        with Bag(path) as reader:
            yield reader
    except ConfigError:
        raise
    except Exception as error:  # damaged files raise many types
        reason = " ".join(str(error).split()) or type(error).__name__
        raise ConfigError(
            f"{path}: cannot be read as a ROS 2 bag ({reason}); is it complete? `ros2 bag reindex` may save it"
        ) from error


def connections_of(reader: Bag, topic: Topic, decoders: Decoders) -> list[Connection]:
    """Return the connections of a topic, one per message type, in ascending order of preference.

    The last connection should be read: among the types with a decoder, it has the largest number of messages.
    """
    candidates = [connection for connection in reader.connections if connection.topic == topic.topic]
    return sorted(candidates, key=lambda item: (item.msgtype in decoders, item.msgcount, item.msgtype))


def require_topics(reader: Bag, path: Path, wanted: Iterable[tuple[Topic, Decoders]]) -> None:
    """Raise ConfigError that lists all topics that are missing from the bag or have no decoder for their type."""
    sentences, missing = [], []
    for topic, decoders in wanted:
        kinds = [connection.msgtype for connection in connections_of(reader, topic, decoders)]
        if not kinds:
            missing.append(f"'{topic.topic}'")
        elif kinds[-1] not in decoders if topic.fields is None else len(kinds) > 1:
            sentences.append(
                f"topic '{topic.topic}' is of type {', '.join(kinds)}; expected {' or '.join(decoders)}; for another "
                "type give 'fields' with the values, and its file under 'definitions'"
            )
    if missing:
        known_topics = ", ".join(sorted({f"{known.topic} ({known.msgtype})" for known in reader.connections})) or "none"
        which = f"no topic {missing[0]}; name it" if len(missing) == 1 else f"no topics {', '.join(missing)}; name them"
        sentences.insert(0, f"{which} under 'topics' in a mapping, {draft_command(path)}; the bag has {known_topics}")
    if sentences:
        raise ConfigError(mistakes(str(path), sentences))


class TopicRequest(NamedTuple):
    """Topic to read, decoders of its message types, and stride n to read every n-th message."""

    topic: Topic
    decoders: Decoders
    stride: int = 1


def read_topics(
    reader: Bag, path: Path, requests: Mapping[str, TopicRequest], definitions: Mapping[str, str] = MappingProxyType({})
) -> dict[str, TopicRows]:
    """Read the requested topics in one pass over the bag, and keep only the numbers of each message.

    Message types come from the library and from the user's files `definitions`. Definitions inside the bag are not
    used, because the library would generate code from them.

    Parameters
    ----------
    reader
        The bag.
    path
        Path of the bag, for messages.
    requests
        Requests by role.
    definitions
        Files of message definitions by type.

    Returns
    -------
    dict
        Rows by role.

    Raises
    ------
    ConfigError
        If a topic is missing, has another type, or holds no message.
    ValueError
        If the bag has fewer messages than its metadata states.
    """
    from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415

    require_topics(reader, path, [(request.topic, request.decoders) for request in requests.values()])
    store = get_typestore(Stores.ROS2_JAZZY)
    parts = requests.values()
    connections = {part.topic.topic: connections_of(reader, part.topic, part.decoders)[-1] for part in parts}
    for known in connections.values():
        _register(path, store, known.msgtype, definitions)
    columns = {role: _Columns(path, request, connections[request.topic.topic]) for role, request in requests.items()}
    by_topic = {name: [part for part in columns.values() if part.connection.topic == name] for name in connections}
    for name, received, data in reader.messages(connections.values()):
        message = None
        for part in by_topic[name]:
            if part.is_due():
                # Several roles may read one topic; a message is decoded once, and only if it is due.
                message = message or store.deserialize_cdr(data, connections[name].msgtype)
                part.take(received, message)
    return {role: part.rows() for role, part in columns.items()}


class _Columns:
    """Accumulated numbers of the messages of one request."""

    def __init__(self, path: Path, request: TopicRequest, connection: Connection) -> None:
        self.connection = connection
        self._path, self._stride, self._messages = path, request.stride, 0
        topic = request.topic
        self._decode = request.decoders[connection.msgtype] if topic.fields is None else _field_decoder(path, topic)
        # Packed arrays: a Python list takes ten times as much memory.
        self._times, self._values = array("q"), array("d")

    def is_due(self) -> bool:
        """Count a message; return True if it is to be read."""
        self._messages += 1
        return (self._messages - 1) % self._stride == 0

    def take(self, received: int, message: Any) -> None:  # noqa: ANN401
        self._times.extend((received, stamp(message)))
        self._values.extend(self._decode(message))

    def rows(self) -> TopicRows:
        name, kind, stated_count = self.connection
        if self._messages < stated_count:
            raise ValueError(f"topic '{name}' holds {self._messages} of {stated_count} messages")
        if not self._messages:
            raise ConfigError(f"{self._path}: topic '{name}' holds no message")
        received, stamped = (np.array(self._times[first::2]) for first in (0, 1))
        # Files of one bag may overlap in time.
        order = np.argsort(received, kind="stable")
        values = np.array(self._values).reshape(len(received), -1)
        return TopicRows(name, received[order], stamped[order], values[order], self._stride, kind)


def _register(path: Path, store: Any, kind: str, definitions: Mapping[str, str]) -> None:  # noqa: ANN401
    """Register the message types that the user defines; raise ConfigError if the type `kind` is still unknown."""
    from rosbags.typesys import get_types_from_msg  # noqa: PLC0415

    for name, file in definitions.items():
        try:
            text = read_input(Path(file), MEGABYTE).decode("utf-8")
            store.register(get_types_from_msg(text, name))
        except Exception as error:  # errors of the library and of reading
            raise ConfigError(f"{file}: cannot be read as the definition of {name} ({error})") from error
    if kind not in store.fielddefs:
        raise ConfigError(f"{path}: messages of type {kind} are unknown; give their .msg file under 'definitions'")


def _entry(message: Any, name: str) -> Any:  # noqa: ANN401
    """Return a field by name, or an entry of an array by index."""
    return message[int(name)] if name.isdigit() else getattr(message, name)


def _field_decoder(path: Path, topic: Topic) -> Callable[[Any], Reading]:
    """Return a decoder of the mapped fields of a message."""
    fields = [field.split(".") for field in topic.fields or ()]

    def decode(message: Any) -> Reading:  # noqa: ANN401
        try:
            return tuple(float(reduce(_entry, field, message)) for field in fields)
        except (AttributeError, IndexError, TypeError, ValueError) as error:
            raise ConfigError(
                f"{path}: topic '{topic.topic}': no number under 'fields' {topic.fields}: {error}"
            ) from error

    return decode
