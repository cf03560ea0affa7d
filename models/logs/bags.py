"""A ROS 2 bag as a log: its topics as rows of numbers, on one clock. Nothing that the bag brings along is run."""

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
from diffdrive_mpc.models.logs.clock_checks import drifting_clocks, require_one_clock
from diffdrive_mpc.models.logs.mapping import LogMapping, Topic, Topics
from diffdrive_mpc.models.logs.record import BoolArray, Finding, ranges
from diffdrive_mpc.models.logs.sampling import RawLog, RawStretch, Signal, increasing, unwrapped, usual_step

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


_DECODERS: dict[str, Decoders] = {"command": COMMANDS, "odometry": ODOMETRY, "imu": IMU, "pose": POSES}
_FIELDS = {"odometry": "twist", "imu": "yaw_rate", "pose": "pose"}


def is_bag(path: Path) -> bool:
    """Whether the path is that of a bag: a folder, or a file with the ending of one."""
    return path.is_dir() or path.suffix in (".mcap", ".db3", ".bag")


def read_bag(path: Path, mapping: LogMapping | None) -> RawLog:
    """Read a ROS 2 bag. Its clock starts at 0 with the first message used.

    Parameters
    ----------
    path
        Folder of the bag, or one of its .mcap or .db3 files.
    mapping
        Which topic is what; None for /cmd_vel, with /odom and /imu as far as they are there.

    Raises
    ------
    models.checked_yaml.ConfigError
        If the bag is damaged, a topic is missing, empty or of another type, the stamps come from two clocks, or the
        command and the sensors have no time in common.
    """
    with opened(path) as reader:
        topics = mapping.topics if mapping else _usual_topics(path, {known.topic for known in reader.connections})
        if topics is None:
            raise ConfigError(f"{path}: the mapping has no 'topics', which a bag needs")
        asked = {role: topic for role in _DECODERS if (topic := getattr(topics, role)) is not None}
        rows = {role: read_topic(reader, path, topic.topic, _DECODERS[role]) for role, topic in asked.items()}
    findings: list[Finding] = []
    times = _times(path, rows, topics, findings)
    origin = min(time.min() for time in times.values())
    signals = {
        role: _signal(path, rows[role], 1e-9 * (times[role] - origin), asked[role], role, findings) for role in rows
    }
    stretch = _stretch(path, signals.pop("command"), {_FIELDS[role]: signal for role, signal in signals.items()})
    response = next(stretch.measured[field] for field in _FIELDS.values() if field in stretch.measured)
    # The faster of the two, so that neither the commands' times nor the readings are blurred.
    sample_time = np.fmin(usual_step([stretch.command.time]), usual_step([response.time]))
    return RawLog(path.name, (stretch,), tuple(findings), float(sample_time))


def _usual_topics(path: Path, there: set[str]) -> Topics:
    usual = {"odometry": "/odom", "imu": "/imu"}
    found = {role: Topic(topic=topic) for role, topic in usual.items() if topic in there}
    if not found:
        raise ConfigError(
            f"{path}: neither /odom nor /imu is there; give a mapping file that names the topics; the bag has "
            f"{', '.join(sorted(there)) or 'none'}"
        )
    return Topics(odometry=found.get("odometry"), imu=found.get("imu"))


def _times(path: Path, rows: dict[str, TopicRows], topics: Topics, findings: list[Finding]) -> dict[str, FloatArray]:
    """Times of each topic's messages [ns]: their stamps where they have them, else when they were received."""
    if topics.clock == "receive":
        return {role: topic.received for role, topic in rows.items()}
    late = {
        topic.topic: 1e-9 * (topic.received - topic.stamped) if topic.has_stamps else np.zeros(1)
        for topic in rows.values()
    }
    require_one_clock(str(path), late, "set `clock: receive` under 'topics' to use the times of receipt")
    findings += drifting_clocks(path.name, late)
    for role, topic in rows.items():
        if not topic.has_stamps and role != "command":
            words = "not every message has a stamp; the times of receipt are used"
            findings.append(Finding("no stamps", "note", f"{path.name}, {topic.topic}", words))
    return {role: topic.stamped if topic.has_stamps else topic.received for role, topic in rows.items()}


def _signal(path: Path, rows: TopicRows, time: FloatArray, topic: Topic, role: str, findings: list[Finding]) -> Signal:
    """One topic's messages in order of time, without those that are not finite or come out of order."""
    where = f"{path.name}, {rows.topic}, message "
    finite = np.isfinite(rows.value).all(axis=1)
    ordered = increasing(time)
    for good, kind, words in (
        (finite, "NaN rows", "messages are not finite"),
        (ordered, "time backwards", "messages are not later than one before them"),
    ):
        if not good.all():
            lost = f"{(~good).sum()} {words}; they are left out"
            findings.append(Finding(kind, "warning", where + ranges(np.flatnonzero(~good) + 1), lost))
    keep = finite & ordered
    value = rows.value[keep]
    if role == "pose":
        value = unwrapped(value * [1.0, 1.0, topic.sign])
    elif role != "command":
        value = value * ([1.0, topic.sign] if role == "odometry" else [topic.sign])
    return Signal(time[keep] - topic.delay, value)


def _stretch(path: Path, command: Signal, measured: dict[str, Signal]) -> RawStretch:
    """The time in which both the command and at least one sensor are there."""
    first = min(signal.time[0] for signal in measured.values())
    last = max(signal.time[-1] for signal in measured.values())
    clock = command.time[(command.time >= first) & (command.time <= last)]
    if not len(clock):
        raise ConfigError(f"{path}: the commands ({_span(command)}) and the sensors have no time in common")
    return RawStretch(clock, command, measured)


def _span(signal: Signal) -> str:
    return f"{signal.time[0]:.1f} to {signal.time[-1]:.1f} s"
