"""A bag of ROS 2 or ROS 1: what its controller said of each tick, or else its topics put together."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from diffdrive_mpc.app.replay.assembly import Readings, assembled, on_grid
from diffdrive_mpc.app.replay.bag_records import LoggedConfigs, read_records, record_topics
from diffdrive_mpc.app.replay.pose_stand_in import by_odometry
from diffdrive_mpc.app.replay.recording import Recording
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.bag_topics import COMMANDS, IMU, ODOMETRY, POSES, Decoders, TopicRows, opened, read_topic
from diffdrive_mpc.models.logs.clock_checks import drifting_clocks, require_one_clock
from diffdrive_mpc.models.logs.mapping import LogMapping, Topic, Topics
from diffdrive_mpc.models.logs.sampling import increasing

if TYPE_CHECKING:
    from diffdrive_mpc.models.logs.bag_topics import Reader

_POSE = "/pose"
_PLANAR = (0, 1, 5)
_FIELDS = {"odometry": "wheel_twist", "imu": "yaw_rate", "pose": "pose"}
_NOT_SAID = (
    "The bag does not say what its controller had received at each tick (record the node's topics ~/tick and ~/drive "
    "for that): a message counts as there at a tick if the recorder had it by then. In lock step that is exact; in "
    "real time a message may slip to the next tick: commands change by less than a mm/s and mrad/s where the computer "
    "kept up, and by as much as 0.06 rad/s were seen where it did not."
)


def _stated(message: Any) -> tuple[float, ...]:  # noqa: ANN401 - the types are made by rosbags
    covariance = np.asarray(message.pose.covariance, dtype=float).reshape(6, 6)[np.ix_(_PLANAR, _PLANAR)]
    return tuple(covariance.ravel()) if covariance.any() else (math.nan,) * 9


_STATED: Decoders = {
    kind: (lambda message, pose=decode, kind=kind: (*pose(message), *_covariance(message, kind)))  # type: ignore[misc]
    for kind, decode in POSES.items()
}


def _covariance(message: Any, kind: str) -> tuple[float, ...]:  # noqa: ANN401
    """As the node takes it: that of an odometry grows with the drift of its frame, which is no error in it."""
    return _stated(message) if kind.endswith("PoseWithCovarianceStamped") else (math.nan,) * 9


def read_bag_drive(
    path: Path, mapping: LogMapping | None, sample_time: float, configs: LoggedConfigs, *, stand_in: bool
) -> Recording:
    """Read a bag.

    Parameters
    ----------
    path, mapping
        The bag, and which topic is what; None for the usual names.
    sample_time
        Of the controller [s].
    configs
        Reads the configurations in it.
    stand_in
        Whether dead reckoning by wheels and gyro takes the place of poses.

    Raises ConfigError if the bag is damaged, or a topic is missing or of another type.
    """
    with opened(path) as reader:
        said = record_topics(reader)
        if said is not None and mapping is None and not stand_in:
            return read_records(reader, path, said, configs)
        topics = (mapping.topics if mapping else None) or Topics()
        return _from_topics(reader, path, topics, sample_time, stand_in=stand_in)


def _from_topics(reader: Reader, path: Path, topics: Topics, sample_time: float, *, stand_in: bool) -> Recording:
    there = {known.topic: known.msgtype for known in reader.connections if known.msgcount}
    topics = topics.named(there)
    approximated, by_odom = [_NOT_SAID], False
    if topics.pose is None and there.get(_POSE) in POSES:
        topics = topics.model_copy(update={"pose": Topic(topic=_POSE)})
    elif topics.pose is None and topics.odometry is not None and topics.odometry.fields is None:
        name = topics.odometry.topic
        topics, by_odom = topics.model_copy(update={"pose": topics.odometry}), True
        approximated.append(f"Poses are those of the odometry ({name}), as the node takes them by default.")
    decoders = {"command": COMMANDS, "odometry": ODOMETRY, "imu": IMU, "pose": POSES if by_odom else _STATED}
    asked = {role: topic for role in decoders if (topic := getattr(topics, role)) is not None}
    rows = {role: read_topic(reader, path, topic, decoders[role], topics.definitions) for role, topic in asked.items()}
    late = {one.topic: 1e-9 * (one.received - one.stamped) if one.has_stamps else np.zeros(1) for one in rows.values()}
    by_stamp = topics.clock == "stamp"
    findings = []
    if by_stamp:
        require_one_clock(str(path), late, "set `clock: receive` under 'topics' to use the times of receipt")
        findings += [str(one) for one in drifting_clocks(path.name, late)]
    origin = min(int(_instants(one, by_stamp=by_stamp)[0]) for one in rows.values())
    readings = {}
    for role, field in _FIELDS.items():
        if role in rows:
            readings[field] = _readings(rows[role], asked[role], origin, field, findings, by_stamp=by_stamp)
    if stand_in:
        readings["pose"] = by_odometry(readings, path.name)
    commands = rows["command"]
    time = _seconds(_instants(commands, by_stamp=by_stamp), origin)
    keep = increasing(time) & np.isfinite(commands.value).all(axis=1)
    if not keep.all():
        findings.append(f"{path.name}, {commands.topic}: {(~keep).sum()} commands out of order or not finite; left out")
    ticks, sent, words = on_grid(time[keep], commands.value[keep], sample_time, path.name)
    if len(ticks) < 2:
        raise ConfigError(f"{path}: fewer than two commands on '{commands.topic}'; record a drive")
    return Recording(
        path.name,
        "bag, its topics put together",
        tuple(assembled(ticks, sent, readings, reset=False)),
        by_controller=True,
        approximated=(*approximated, *words),
        findings=tuple(findings),
    )


def _instants(rows: TopicRows, *, by_stamp: bool) -> FloatArray:
    return rows.stamped if by_stamp and rows.has_stamps else rows.received


def _seconds(instants: FloatArray, origin: int) -> FloatArray:
    """Differences of whole nanoseconds, which are exact before they are rounded."""
    return np.asarray((instants.astype(np.int64) - origin) / 1e9)


def _readings(
    rows: TopicRows, topic: Topic, origin: int, field: str, findings: list[str], *, by_stamp: bool
) -> Readings:
    """Messages of a topic that the node would take: finite, and newer than those before."""
    stamp = _seconds(_instants(rows, by_stamp=by_stamp), origin) - topic.delay
    value = rows.value if field != "pose" else rows.value[:, :3]
    keep = increasing(stamp) & np.isfinite(value).all(axis=1)
    if not keep.all():
        findings.append(f"{rows.topic}: {(~keep).sum()} messages are not finite or not newer than before; left out")
    stated = rows.value[:, 3:].reshape(-1, 3, 3)[keep] if field == "pose" and rows.value.shape[1] > 3 else None
    signs = np.array([1.0, 1.0, topic.sign][-value.shape[1] :])
    arrival = np.maximum.accumulate(_seconds(rows.received, origin)[keep])
    return Readings(arrival, stamp[keep], value[keep] * signs, stated)
