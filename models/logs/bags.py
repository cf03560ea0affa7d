"""A bag of ROS 2 or ROS 1 as a log: its topics on one clock."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.bag_topics import COMMANDS, IMU, ODOMETRY, POSES, Decoders, TopicRows, opened, read_topic
from diffdrive_mpc.models.logs.check_settings import check_settings
from diffdrive_mpc.models.logs.clock_checks import drifting_clocks, require_one_clock
from diffdrive_mpc.models.logs.long_logs import decimated, most_driven, needed_stride, subset
from diffdrive_mpc.models.logs.mapping import LogMapping, Topic, Topics
from diffdrive_mpc.models.logs.record import Finding, ranges
from diffdrive_mpc.models.logs.sampling import ABSURD, RawLog, RawStretch, Signal, increasing, unwrapped, usual_step

if TYPE_CHECKING:
    from diffdrive_mpc.models.logs.bag_topics import Reader

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
        findings: list[Finding] = []
        rows = {
            role: read_topic(
                reader, path, topic, _DECODERS[role], topics.definitions, _stride(reader, path, topic, role, findings)
            )
            for role, topic in asked.items()
        }
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
    stretches = _most_driven(path, stretch, findings)
    # The faster of the two, so that neither the commands' times nor the readings are blurred.
    sample_time = usual_step([response.time])
    if not topics.command.on_change:
        sample_time = float(np.fmin(usual_step([stretch.command.time]), sample_time))
    return RawLog(path.name, stretches, tuple(findings), float(sample_time))


def _stride(reader: Reader, path: Path, topic: Topic, role: str, findings: list[Finding]) -> int:
    """One in how many messages of a sensor is needed; of commands every one is."""
    count = sum(connection.msgcount for connection in reader.connections if connection.topic == topic.topic)
    if role == "command" or count < 2:
        return 1
    period = 1e-9 * reader.duration / count
    stride = needed_stride(period, check_settings())
    if stride > 1:
        findings.append(decimated(f"{path.name}, {topic.topic}", "message", stride, period))
    return stride


def _most_driven(path: Path, stretch: RawStretch, findings: list[Finding]) -> tuple[RawStretch, ...]:
    """Of a bag with too many commands to be used whole the parts in which they change most."""
    command, most = stretch.command, check_settings().most_rows
    if len(command.time) <= most:
        return (stretch,)
    taken = most_driven(list(command.value.T), most)
    findings.append(subset(path.name, "commands", len(taken), len(command.time)))
    spans = np.split(taken, np.flatnonzero(np.diff(taken) > 1) + 1)
    return tuple(stretch.between(command.time[span[0]], command.time[span[-1]]) for span in spans)


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
    finite = (np.abs(rows.value) < ABSURD).all(axis=1)
    ordered = increasing(time)
    for good, kind, words in (
        (finite, "NaN rows", "messages are not finite"),
        (ordered, "time backwards", "messages are not later than one before them"),
    ):
        if not good.all():
            lost = f"{(~good).sum()} {words}; they are left out"
            findings.append(Finding(kind, "warning", where + ranges(rows.stride * np.flatnonzero(~good) + 1), lost))
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
