"""A bag of ROS 2 or ROS 1 as a log: its topics as rows of numbers, on one clock. Nothing in it is ever run."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import reduce
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.clock_checks import drifting_clocks, require_one_clock
from diffdrive_mpc.models.logs.mapping import LogMapping, Topic, Topics
from diffdrive_mpc.models.logs.record import BoolArray, Finding, ranges
from diffdrive_mpc.models.logs.sampling import RawLog, RawStretch, Signal, increasing, unwrapped, usual_step

if TYPE_CHECKING:
    from rosbags.rosbag1 import Reader as Reader1
    from rosbags.rosbag2 import Reader as Reader2

    Reader = Reader1 | Reader2

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
    """Open a rosbag2, its folder or one .mcap or .db3 file, or a .bag of ROS 1.

    Raises
    ------
    ConfigError
        If it cannot be read, here or while the context reads on.
    """
    # Only those who read bags need the library.
    from rosbags.rosbag1 import Reader as Reader1  # noqa: PLC0415
    from rosbags.rosbag2 import Reader as Reader2  # noqa: PLC0415

    try:
        with (Reader1 if of_ros1(path) else Reader2)(path) as reader:
            yield reader
    except ConfigError:
        raise
    except Exception as error:  # a damaged file fails in as many ways as there are bytes
        reason = " ".join(str(error).split()) or type(error).__name__
        kind, rescue = ("ROS 1", "rosbag reindex") if of_ros1(path) else ("ROS 2", "ros2 bag reindex")
        raise ConfigError(
            f"{path}: cannot be read as a {kind} bag ({reason}); is it complete? `{rescue}` may save it"
        ) from error


def of_ros1(path: Path) -> bool:
    """Whether the path is that of a bag of ROS 1: one file that says so in its first bytes, or by its ending."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(7) == b"#ROSBAG" or path.suffix == ".bag"


def read_topic(
    reader: Reader, path: Path, topic: Topic, decoders: Decoders, definitions: Mapping[str, str] = MappingProxyType({})
) -> TopicRows:
    """Read all messages of one topic.

    Message types are the library's own and those of `definitions`, files that the user names, by type; never the
    definitions inside the bag, from which it would generate code.

    Raises
    ------
    ConfigError
        If the bag has no such topic, the topic has another type, or it holds no message.
    ValueError
        If messages have been lost.
    """
    from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415

    name = topic.topic
    connections: list[Any] = [connection for connection in reader.connections if connection.topic == name]
    if not connections:
        there = ", ".join(sorted({f"{known.topic} ({known.msgtype})" for known in reader.connections})) or "none"
        raise ConfigError(f"{path}: no topic '{name}'; name it under 'topics' in the mapping; the bag has {there}")
    kinds = sorted({connection.msgtype for connection in connections})
    if topic.fields is not None:
        decoders = dict.fromkeys(kinds, _reader_of(path, topic))
    if len(kinds) > 1 or kinds[0] not in decoders:
        raise ConfigError(
            f"{path}: topic '{name}' is of type {', '.join(kinds)}; expected {' or '.join(decoders)}; of "
            "another type name "
            "'fields', where its numbers stand, and a file for it under 'definitions'"
        )
    ros1 = of_ros1(path)
    store, decode = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_JAZZY), decoders[kinds[0]]
    _register(path, store, kinds[0], definitions)
    received, stamped, values = [], [], []
    for _, timestamp, data in reader.messages(connections=connections):
        message = (store.deserialize_ros1 if ros1 else store.deserialize_cdr)(data, kinds[0])
        received.append(timestamp)
        stamped.append(stamp(message))
        values.append(decode(message))
    promised = sum(connection.msgcount for connection in connections)
    if len(values) < promised:  # the library skips what it cannot make out in a damaged file
        raise ValueError(f"topic '{name}' holds {len(values)} of {promised} messages")
    if not values:
        raise ConfigError(f"{path}: topic '{name}' holds no message")
    return TopicRows(name, np.array(received), np.array(stamped), np.array(values))


def _register(path: Path, store: Any, kind: str, definitions: Mapping[str, str]) -> None:  # noqa: ANN401
    """Teach the library the types that the user defines; raises ConfigError where one of `kind` is still unknown."""
    from rosbags.typesys import get_types_from_msg  # noqa: PLC0415

    for name, file in definitions.items():
        try:
            store.register(get_types_from_msg(Path(file).read_text(encoding="utf-8"), name))
        except Exception as error:  # the library's own, and those of reading
            raise ConfigError(f"{file}: cannot be read as the definition of {name} ({error})") from error
    if kind not in store.fielddefs:
        raise ConfigError(f"{path}: messages of type {kind} are unknown; give their .msg file under 'definitions'")


def _reader_of(path: Path, topic: Topic) -> Callable[[Any], Reading]:
    """Takes the numbers out of a message where the mapping says that they stand."""
    fields = [field.split(".") for field in topic.fields or ()]

    def decode(message: Any) -> Reading:  # noqa: ANN401
        try:
            return tuple(float(reduce(getattr, field, message)) for field in fields)
        except (AttributeError, TypeError, ValueError) as error:
            raise ConfigError(
                f"{path}: topic '{topic.topic}': no number under 'fields' {topic.fields}: {error}"
            ) from error

    return decode


_WIDTHS = {"command": 2, "odometry": 2, "imu": 1, "pose": 3}
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
        there = {known.topic for known in reader.connections}
        topics = mapping.topics if mapping else Topics()
        if topics is None:
            raise ConfigError(f"{path}: the mapping has no 'topics', which a bag needs")
        topics = topics.named(there)
        asked = {role: topic for role in _DECODERS if (topic := getattr(topics, role)) is not None}
        if set(asked) == {"command"}:
            raise ConfigError(
                f"{path}: neither /odom nor /imu is there; give a mapping file that names the topics; the bag has "
                f"{', '.join(sorted(there)) or 'none'}"
            )
        for role, topic in asked.items():
            if topic.fields is not None and len(topic.fields) != _WIDTHS[role]:
                raise ConfigError(
                    f"{path}: topic '{topic.topic}': give {_WIDTHS[role]} 'fields', not {len(topic.fields)}"
                )
        rows = {
            role: read_topic(reader, path, topic, _DECODERS[role], topics.definitions) for role, topic in asked.items()
        }
    findings: list[Finding] = []
    times = _times(path, rows, topics, findings)
    origin = min(time.min() for time in times.values())
    signals = {
        role: _signal(path, rows[role], 1e-9 * (times[role] - origin), asked[role], role, findings) for role in rows
    }
    command = signals.pop("command")
    measured = {_FIELDS[role]: signal for role, signal in signals.items()}
    response = next(measured[field] for field in _FIELDS.values() if field in measured)
    if topics.command.on_change:
        command = _repeated(command, response.time)
    stretch = _stretch(path, command, measured)
    # The faster of the two, so that neither the commands' times nor the readings are blurred.
    sample_time = usual_step([response.time])
    if not topics.command.on_change:
        sample_time = float(np.fmin(usual_step([stretch.command.time]), sample_time))
    return RawLog(path.name, (stretch,), tuple(findings), float(sample_time))


def _repeated(command: Signal, clock: FloatArray) -> Signal:
    """Commands that are sent when they change, once more at every time of `clock` (n,) [s] from the first on."""
    time = np.union1d(command.time, clock[clock >= command.time[0]])
    return Signal(time, command.value[np.searchsorted(command.time, time, side="right") - 1])


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
