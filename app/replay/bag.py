"""A bag of ROS 2 or ROS 1: what its controller said of each tick, or else its topics put together."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from diffdrive_mpc.app.replay.assembly import Readings, assembled, on_grid
from diffdrive_mpc.app.replay.recording import RecordedTick, Recording, Start
from diffdrive_mpc.app.replay.signals import by_odometry
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.bag_topics import COMMANDS, IMU, ODOMETRY, POSES, Decoders, TopicRows, opened, read_topic
from diffdrive_mpc.models.logs.mapping import LogMapping, Topic, Topics
from diffdrive_mpc.models.logs.record_checks import drifting_clocks, require_one_clock
from diffdrive_mpc.models.logs.sampling import increasing
from diffdrive_mpc.models.logs.tick_record import DriveRecord, TickRecord, TickRecordError
from diffdrive_mpc.models.trust import UntrustedFileError
from diffdrive_mpc.mpc import ControllerConfig
from diffdrive_mpc.mpc.config.config_file import config_from_log
from diffdrive_mpc.mpc.hold import Hold
from diffdrive_mpc.mpc.trajectories.tabled import TabledTrajectory

if TYPE_CHECKING:
    from diffdrive_mpc.models.logs.bag_topics import Reader


# A bag with what the node said of each tick: its controller's drive, bit for bit.


_TEXT = "std_msgs/msg/String"
_LATE = 1.5
"""A first tick later than so many samples after the start has others before it."""


@dataclass(frozen=True)
class LoggedConfigs:
    """Reads the configurations that stand in a log.

    Attributes
    ----------
    log
        The log.
    scratch
        Folder for the texts of models that do not ship.
    trusted
        Folders whose files a configuration may name; None: one that names files is left out, since another one drives.
    """

    log: Path
    scratch: Path
    trusted: Sequence[Path] | None = ()

    def read(self, config: Mapping[str, Any], model: str) -> ControllerConfig | None:
        """The configuration, with the text of its `model` where that does not ship; raises as `config_from_log`."""
        values = dict(config)
        if model:
            file = self.scratch / f"{hashlib.sha256(model.encode()).hexdigest()[:12]}.yaml"
            file.write_text(model, encoding="utf-8")
            values["model"] = str(file)
        try:
            return config_from_log(values, self.log, (self.scratch, *(self.trusted or ())))
        except UntrustedFileError:
            if self.trusted is None:
                return None
            raise


def record_topics(reader: Reader) -> tuple[str, str] | None:
    """Names of the topics of ticks and drives; None where the bag has none."""
    texts = {known.topic for known in reader.connections if known.msgtype == _TEXT and known.msgcount}
    ticks = sorted(name for name in texts if name.endswith("/tick"))
    return next(((name, name[: -len("tick")] + "drive") for name in ticks), None)


def read_records(reader: Reader, path: Path, topics: tuple[str, str], configs: LoggedConfigs) -> Recording:
    """The drive of a bag with these topics; errors are those of `recorded_drive`."""
    of_ticks, of_drives = (_lines(reader, name) for name in topics)
    return recorded_drive(path, "bag of the node", of_ticks, of_drives, configs)


def recorded_drive(
    path: Path, source: str, of_ticks: Iterable[str], of_drives: Iterable[str], configs: LoggedConfigs
) -> Recording:
    """The drive that lines of its ticks and drives tell.

    Raises ConfigError where a line is none, there is no tick, or a configuration names a file that is not trusted.
    """
    try:
        ticks = _numbered([TickRecord.read(line) for line in of_ticks])
        drives = _numbered([DriveRecord.read(line) for line in of_drives])
    except TickRecordError as error:
        raise ConfigError(f"{path}: {error}") from error
    if not ticks:
        raise ConfigError(f"{path}: no tick at which the controller drove is in it")
    by_number = dict(drives)
    config_of = {key: configs.read(drive.config, drive.model) for key, drive in drives}
    recorded: list[RecordedTick] = []
    approximated: list[str] = []
    now: tuple[int, int] | None = None
    for key, record in ticks:
        hold = None if record.hold is None else Hold(*record.hold)
        tick = RecordedTick(record.time, record.measurement, record.command, hold)
        tick = replace(
            tick,
            mode=record.mode,
            solver_path=record.solver_path,
            message=record.message,
            stopped_after=record.stopped_after,
        )
        if key != now:
            tick = _begin(tick, by_number.get(key), config_of.get(key), now is None, approximated)
        now = key
        recorded.append(tick)
    numbers = np.diff([record.number for _, record in ticks])
    missing = int((numbers[numbers > 1] - 1).sum())
    if missing:
        approximated.append(
            f"{missing} ticks are missing from the bag: commands differ after each gap until the estimate has settled."
        )
    config = next(iter(config_of.values()), None)
    return Recording(path.name, source, tuple(recorded), config=config, approximated=tuple(approximated))


def _begin(
    tick: RecordedTick, drive: DriveRecord | None, config: ControllerConfig | None, first: bool, approximated: list[str]
) -> RecordedTick:
    """The first tick of a drive, or of a change of its configuration."""
    if drive is None:
        approximated.append(
            "What the controller tracked, and its configuration, are not in the bag: record the topic ~/drive as well."
        )
        return replace(tick, start=Start(None, tick.time, reset=False))
    if not (drive.starts or first):
        return replace(tick, config=config)
    if first and config is not None and tick.time - drive.t0 > _LATE * config.sample_time:
        approximated.append(
            f"The bag begins {tick.time - drive.t0:.1f} s after the start of the drive: what the controller had "
            "learned by then is not in it. Commands may differ until the estimate has settled, some seconds."
        )
    reference = None if drive.reference is None else TabledTrajectory.of(drive.reference)
    # Of a drive that is recorded from its middle nothing is there to go on from.
    start = Start(reference, drive.t0, drive.reset, goes_on=drive.goes_on and not first)
    return replace(tick, start=start, config=config if not drive.starts else None)


def _numbered(records: Sequence[Any]) -> list[tuple[tuple[int, int], Any]]:
    """Each with the activation of the node and the drive that it belongs to: numbers begin anew with an activation."""
    activation, last, numbered = 0, 0, []
    for record in records:
        number = record.number if isinstance(record, DriveRecord) else record.drive
        activation += number < last
        last = number
        numbered.append(((activation, number), record))
    return numbered


def _lines(reader: Reader, topic: str) -> Iterator[str]:
    from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415 - only who reads bags needs it

    store = get_typestore(Stores.ROS2_JAZZY)
    connections: list[Any] = [known for known in reader.connections if known.topic == topic]
    if not connections:
        return
    for _, _, data in reader.messages(connections=connections):
        message: Any = store.deserialize_cdr(data, _TEXT)
        yield str(message.data)


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
        recorded_topics = record_topics(reader)
        if recorded_topics is not None and mapping is None and not stand_in:
            return read_records(reader, path, recorded_topics, configs)
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
    topic_names = {role: topic for role in decoders if (topic := getattr(topics, role)) is not None}
    rows = {
        role: read_topic(reader, path, topic, decoders[role], topics.definitions) for role, topic in topic_names.items()
    }
    late = {row.topic: 1e-9 * (row.received - row.stamped) if row.has_stamps else np.zeros(1) for row in rows.values()}
    by_stamp = topics.clock == "stamp"
    findings = []
    if by_stamp:
        require_one_clock(str(path), late, "set `clock: receive` under 'topics' to use the times of receipt")
        findings += [str(drifting_clock) for drifting_clock in drifting_clocks(path.name, late)]
    origin = min(int(_instants(row, by_stamp=by_stamp)[0]) for row in rows.values())
    readings = {}
    for role, field in _FIELDS.items():
        if role in rows:
            readings[field] = _readings(rows[role], topic_names[role], origin, field, findings, by_stamp=by_stamp)
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
