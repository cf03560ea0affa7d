"""A bag with what the node said of each tick: its controller's drive, bit for bit."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from diffdrive_mpc.app.replay.recording import Recording, Start, Tick
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.logs.tick_record import DriveRecord, TickRecord, TickRecordError
from diffdrive_mpc.models.trust import UntrustedFileError
from diffdrive_mpc.mpc import ControllerConfig
from diffdrive_mpc.mpc.config.config_file import config_from_log
from diffdrive_mpc.mpc.hold import Hold
from diffdrive_mpc.mpc.trajectories.tabled import TabledTrajectory

if TYPE_CHECKING:
    from diffdrive_mpc.models.logs.bag_topics import Reader

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
    found: list[Tick] = []
    approximated: list[str] = []
    now: tuple[int, int] | None = None
    for key, record in ticks:
        hold = None if record.hold is None else Hold(*record.hold)
        tick = Tick(record.time, record.measurement, record.command, hold)
        tick = replace(tick, mode=record.mode, solver_path=record.solver_path, message=record.message)
        if key != now:
            tick = _begin(tick, by_number.get(key), config_of.get(key), now is None, approximated)
        now = key
        found.append(tick)
    numbers = np.diff([record.number for _, record in ticks])
    missing = int((numbers[numbers > 1] - 1).sum())
    if missing:
        approximated.append(
            f"{missing} ticks are missing from the bag: commands differ after each gap until the estimate has settled."
        )
    config = next(iter(config_of.values()), None)
    return Recording(path.name, source, tuple(found), config=config, approximated=tuple(approximated))


def _begin(
    tick: Tick, drive: DriveRecord | None, config: ControllerConfig | None, first: bool, approximated: list[str]
) -> Tick:
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
    activation, last, found = 0, 0, []
    for record in records:
        number = record.number if isinstance(record, DriveRecord) else record.drive
        activation += number < last
        last = number
        found.append(((activation, number), record))
    return found


def _lines(reader: Reader, topic: str) -> Iterator[str]:
    from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415 - only who reads bags needs it

    store = get_typestore(Stores.ROS2_JAZZY)
    connections: list[Any] = [known for known in reader.connections if known.topic == topic]
    if not connections:
        return
    for _, _, data in reader.messages(connections=connections):
        message: Any = store.deserialize_cdr(data, _TEXT)
        yield str(message.data)
