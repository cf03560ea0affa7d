"""Reader of ROS 2 bags as logs: conversion of topics to signals on a common clock."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.bag_reader import Bag
from diffdrive_mpc.models.logs.bag_topics import (
    BATTERIES,
    COMMANDS,
    IMU,
    ODOMETRY,
    POSES,
    Decoders,
    TopicRequest,
    TopicRows,
    connections_of,
    motor_readers,
    open_bag,
    read_topics,
    require_topics,
)
from diffdrive_mpc.models.logs.check_settings import check_settings
from diffdrive_mpc.models.logs.command_bursts import check_bursts, silences
from diffdrive_mpc.models.logs.csv_log import motor_fields
from diffdrive_mpc.models.logs.imu_mount import imu_decoders
from diffdrive_mpc.models.logs.long_logs import decimation_finding, most_excited_rows, required_stride, subset_finding
from diffdrive_mpc.models.logs.mapping import (
    FACTORS,
    LogMapping,
    MappedWheels,
    MotorTopic,
    Topic,
    Topics,
    draft_command,
)
from diffdrive_mpc.models.logs.record import Finding, format_ranges
from diffdrive_mpc.models.logs.record_checks import drifting_clocks, require_one_clock
from diffdrive_mpc.models.logs.sampling import (
    MAX_VALUE,
    RawLog,
    RawStretch,
    Signal,
    is_increasing,
    repeat,
    unwrap,
    usual_step,
)

_WIDTHS = {"command": 2, "odometry": 2, "imu": 1, "pose": 3, "battery": 2}
_DECODERS: dict[str, Decoders] = {
    "command": COMMANDS,
    "odometry": ODOMETRY,
    "imu": IMU,
    "pose": POSES,
    "battery": BATTERIES,
}
_FIELDS = {"odometry": "twist", "imu": "yaw_rate", "pose": "pose"}
_SIDES = ("left motors", "right motors")
# Number of motors per side if each motor is read separately.
_MOTORS_PER_SIDE = 2


def is_bag(path: Path) -> bool:
    """Return True if the path is a folder or has the extension of a bag."""
    return path.is_dir() or path.suffix in (".mcap", ".db3", ".bag", ".zst", ".zstd")


def read_bag(path: Path, mapping: LogMapping | None) -> RawLog:
    """Read a ROS 2 bag. Time 0 is the first message used.

    Parameters
    ----------
    path
        Folder of the bag, or one of its .mcap or .db3 files.
    mapping
        Mapping of the topics; None for /cmd_vel, with /odom and /imu if present.

    Raises
    ------
    models.checked_yaml.ConfigError
        If the bag is damaged, a topic is missing, empty or of another type, the stamps come from two clocks, or the
        command and the sensors have no time in common.
    """
    with open_bag(path) as reader:
        recorded = {known.topic for known in reader.connections}
        topics = mapping.topics if mapping else Topics()
        if topics is None:
            raise ConfigError(f"{path}: the mapping has no 'topics', which a bag needs")
        topics = topics.resolve(recorded)
        requested = _requested_topics(path, topics, recorded)
        readers = dict(_DECODERS)
        if topics.imu is not None and topics.imu.sign > 0:  # as in the node, sign -1 is used instead of transforms
            readers["imu"] = imu_decoders(reader)
        if topics.motors is not None:
            for role, side in zip(_SIDES, (topics.motors.left, topics.motors.right), strict=True):
                requested[role], readers[role] = side, motor_readers(side)
        require_topics(reader, path, [(topic, readers[role]) for role, topic in requested.items()])
        findings: list[Finding] = []
        for role, topic in requested.items():
            types = [known.msgtype for known in connections_of(reader, topic, readers[role])]
            if len(types) > 1:
                message = (
                    f"the topic has types {', '.join(sorted(types))}; only {types[-1]}, the most frequent, is read"
                )
                findings.append(Finding("two types", "warning", f"{path.name}, {topic.topic}", message))
        requests = {
            role: TopicRequest(topic, readers[role], _stride(reader, path, topic, role, findings))
            for role, topic in requested.items()
        }
        rows = read_topics(reader, path, requests, topics.definitions)
    times = _times(path, rows, topics, findings)
    origin = min(time.min() for time in times.values())
    signals = {
        role: _signal(path, rows[role], 1e-9 * (times[role] - origin), requested[role], role, findings) for role in rows
    }
    command = signals.pop("command")
    measured = {_FIELDS[role]: signals[role] for role in _FIELDS if role in signals}
    power = _power(signals, mapping.wheels if mapping else None)
    response = next(measured[field] for field in _FIELDS.values() if field in measured)
    if topics.command.on_change:
        command = repeat(command, response.time)
    stretch = _stretch(path, command, measured)
    # Commands that are sent on change are irregular, so the clock of the sensor is checked for gaps instead.
    clock = response.time[response.time >= command.time[0]] if topics.command.on_change else stretch.clock
    stretch = RawStretch(clock, stretch.command, {**stretch.measured, **power})
    stretches = _most_driven_parts(path, stretch, findings)
    # The shorter of both steps preserves the times of commands and readings.
    sample_time = usual_step([response.time])
    silence = None if topics.command.on_change else silences(stretch.command, check_settings())
    if silence is not None:
        findings += check_bursts(f"{path.name}, {topics.command.topic}", silence, measured, check_settings())
    elif not topics.command.on_change:
        sample_time = float(np.fmin(usual_step([stretch.command.time]), sample_time))
    kinds = {role: (rows_of_topic.topic, rows_of_topic.kind) for role, rows_of_topic in rows.items()}
    return RawLog(path.name, stretches, tuple(findings), float(sample_time), kinds)


def _requested_topics(path: Path, topics: Topics, recorded: set[str]) -> dict[str, Topic]:
    """Select the topics of command and sensors by role.

    Raises
    ------
    models.checked_yaml.ConfigError
        If no sensor is available, or a topic has the wrong number of fields.
    """
    requested: dict[str, Topic] = {role: topic for role in _DECODERS if (topic := getattr(topics, role)) is not None}
    if not set(requested) & set(_FIELDS):
        missing = "" if topics.command.topic in recorded else f", nor is the command {topics.command.topic}"
        raise ConfigError(
            f"{path}: neither /odom nor /imu is in the bag{missing}; give a mapping file that names the topics, "
            f"{draft_command(path)}; the bag has {', '.join(sorted(recorded)) or 'none'}"
        )
    for role, topic in requested.items():
        is_position = role == "pose" and topic.fields is not None and len(topic.fields) == len("xy")
        if topic.fields is not None and not is_position and len(topic.fields) != _WIDTHS.get(role, len(topic.fields)):
            raise ConfigError(f"{path}: topic '{topic.topic}': give {_WIDTHS[role]} 'fields', not {len(topic.fields)}")
    return requested


def _power(signals: dict[str, Signal], wheels: MappedWheels | None) -> dict[str, Signal]:
    """Return signals of battery and motors, and with them wheel speeds from the odometry; {} if both are missing."""
    power_signals: dict[str, Signal] = {}
    if "battery" in signals:
        power_signals["battery"] = signals["battery"]
    sides = [signals[role] for role in _SIDES if role in signals]
    if sides:
        left, right = sides
        # The two topics have different times; interpolate the right side at the times of the left.
        overlap = (left.time >= right.time[0]) & (left.time <= right.time[-1])
        time = left.time[overlap]
        right_values = np.stack([np.interp(time, right.time, column) for column in right.value.T], axis=-1)
        both = (
            np.stack([left.value[overlap], right_values], axis=-1)
            if left.value.shape[1] == right.value.shape[1]
            else None
        )
        if both is not None and both.shape[1] == _MOTORS_PER_SIDE:
            values = both.reshape(len(time), -1)  # front left, front right, rear left, rear right
        else:
            values = np.stack([left.value[overlap].sum(axis=1), right_values.sum(axis=1)], axis=-1)
        power_signals |= {name: Signal(time, value) for name, value in motor_fields(values).items()}
    if power_signals and wheels is not None and wheels.radius is not None and "odometry" in signals:
        twist = signals["odometry"]
        half = 0.5 * wheels.track * np.array([[-1.0, 1.0]])
        speeds = (twist.value[:, :1] + half * twist.value[:, 1:]) / wheels.radius
        power_signals["wheels"] = Signal(twist.time, speeds)
    return power_signals


def _stride(reader: Bag, path: Path, topic: Topic, role: str, findings: list[Finding]) -> int:
    """Return the stride n to read every n-th message of a topic; 1 for commands."""
    count = sum(connection.msgcount for connection in reader.connections if connection.topic == topic.topic)
    if role == "command" or count < 2:
        return 1
    period = 1e-9 * reader.duration / count
    stride = required_stride(period, check_settings())
    if stride > 1:
        findings.append(decimation_finding(f"{path.name}, {topic.topic}", "message", stride, period))
    return stride


def _most_driven_parts(path: Path, stretch: RawStretch, findings: list[Finding]) -> tuple[RawStretch, ...]:
    """Reduce a bag with too many commands to the parts with the largest changes of commands."""
    command, max_rows = stretch.command, check_settings().max_rows
    if len(command.time) <= max_rows:
        return (stretch,)
    rows = most_excited_rows(list(command.value.T), max_rows)
    findings.append(subset_finding(path.name, "commands", len(rows), len(command.time)))
    spans = np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1)
    return tuple(stretch.between(command.time[span[0]], command.time[span[-1]]) for span in spans)


def _times(path: Path, rows: dict[str, TopicRows], topics: Topics, findings: list[Finding]) -> dict[str, FloatArray]:
    """Return the times of each topic's messages [ns]: header stamps if available, else times of receipt."""
    if topics.clock == "receive":
        return {role: topic.received for role, topic in rows.items()}
    delays = {
        topic.topic: 1e-9 * (topic.received - topic.stamped) if topic.has_stamps else np.zeros(1)
        for topic in rows.values()
    }
    require_one_clock(str(path), delays, "set `clock: receive` under 'topics' to use the times of receipt")
    findings += drifting_clocks(path.name, delays)
    for role, topic in rows.items():
        if not topic.has_stamps and role != "command":
            message = "not every message has a stamp; the times of receipt are used"
            findings.append(Finding("no stamps", "note", f"{path.name}, {topic.topic}", message))
    return {role: topic.stamped if topic.has_stamps else topic.received for role, topic in rows.items()}


def _signal(path: Path, rows: TopicRows, time: FloatArray, topic: Topic, role: str, findings: list[Finding]) -> Signal:
    """Build the signal of one topic in order of time, without invalid or out-of-order messages."""
    prefix = f"{path.name}, {rows.topic}, message "
    finite = (np.abs(rows.value) < MAX_VALUE).all(axis=1)
    ordered = is_increasing(time)
    for is_good, kind, reason in (
        (finite, "NaN rows", "messages are not finite"),
        (ordered, "time backwards", "messages are not later than an earlier message"),
    ):
        if not is_good.all():
            message = f"{(~is_good).sum()} {reason} and are left out"
            place = prefix + format_ranges(rows.stride * np.flatnonzero(~is_good) + 1)
            findings.append(Finding(kind, "warning", place, message))
    keep = finite & ordered
    value = rows.value[keep]
    if not keep.any() and role in ("battery", *_SIDES):
        joints = getattr(topic, "joints", None)
        remedy = f"check the joints {', '.join(joints)}" if joints else "leave it out of the mapping"
        raise ConfigError(f"{path}: topic '{rows.topic}' holds no usable number; {remedy}")
    if role == "pose":
        value = unwrap(value * np.array([1.0, 1.0, topic.sign])[: value.shape[1]])
    elif role in _SIDES:
        assert isinstance(topic, MotorTopic)
        value = topic.sign * FACTORS[topic.unit] * value
    elif role != "command":
        value = value * ([1.0, topic.sign] if role in ("odometry", "battery") else [topic.sign])
    return Signal(time[keep] - topic.delay, value)


def _stretch(path: Path, command: Signal, measured: dict[str, Signal]) -> RawStretch:
    """Build the stretch in which the command and at least one sensor are present."""
    first = min(signal.time[0] for signal in measured.values())
    last = max(signal.time[-1] for signal in measured.values())
    clock = command.time[(command.time >= first) & (command.time <= last)]
    if not len(clock):
        span = f"{command.time[0]:.1f} to {command.time[-1]:.1f} s"
        raise ConfigError(f"{path}: the commands ({span}) and the sensors have no time in common")
    return RawStretch(clock, command, measured)
