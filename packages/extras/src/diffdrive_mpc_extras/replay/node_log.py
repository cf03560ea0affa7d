"""The drive of a node, from the records that it publishes for each tick: it can be repeated bit for bit."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.logs.tick_record import DriveRecord, TickRecord, TickRecordError
from diffdrive_mpc.models.trust import UntrustedFileError
from diffdrive_mpc.mpc import ControllerConfig
from diffdrive_mpc.mpc.hold import Hold
from diffdrive_mpc_extras.replay.logged_config import config_from_log
from diffdrive_mpc_extras.replay.recording import RecordedTick, Recording, Start
from diffdrive_mpc_extras.replay.reference import TabledTrajectory

_LATE_START = 1.5
"""Delay of the first tick after the start, in samples, above which ticks are missing."""
_NO_DRIVE = "The log lacks the topic ~/drive with the reference and the configuration of the controller."


@dataclass(frozen=True)
class LoggedConfigs:
    """Reader of the configurations in a log.

    Attributes
    ----------
    log
        Path of the log.
    scratch
        Folder for the texts of models that do not ship.
    trusted
        Folders whose files a configuration may name. With None a configuration that names other files is left out,
        because another configuration drives.
    """

    log: Path
    scratch: Path
    trusted: Sequence[Path] | None = ()

    def read(self, config: Mapping[str, Any], model: str) -> ControllerConfig | None:
        """Return the configuration, with the text of its `model` if that does not ship; raise as `config_from_log`."""
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


def recorded_drive(path: Path, ticks: Iterable[str], drives: Iterable[str], configs: LoggedConfigs) -> Recording:
    """Return the drive in the lines of the topics ~/tick and ~/drive.

    Raises ConfigError if a line is no record, there is no tick, or a configuration names a file that is not trusted.
    """
    try:
        tick_records = _numbered([TickRecord.read(line) for line in ticks])
        drive_records = dict(_numbered([DriveRecord.read(line) for line in drives]))
    except TickRecordError as error:
        raise ConfigError(f"{path}: {error}") from error
    if not tick_records:
        raise ConfigError(f"{path}: the log holds no tick of the controller; record for longer")
    config_of = {key: configs.read(drive.config, drive.model) for key, drive in drive_records.items()}
    recorded: list[RecordedTick] = []
    notes: list[str] = []
    current: tuple[int, int] | None = None
    for key, record in tick_records:
        start, config = None, None
        if key != current:
            is_first, current = current is None, key
            start, config = _start(record.time, drive_records.get(key), config_of.get(key), is_first, notes)
        hold = None if record.hold is None else Hold(*record.hold)
        outcome = (record.command, record.mode, record.message)
        recorded.append(
            RecordedTick(record.time, record.measurement, *outcome, hold, start, config, record.stopped_after)
        )
    numbers = np.diff([record.number for _, record in tick_records])
    if missing := int((numbers[numbers > 1] - 1).sum()):
        notes.append(f"{missing} ticks are missing: commands differ after each gap until the estimate has settled.")
    return Recording(path.name, tuple(recorded), next(iter(config_of.values()), None), tuple(notes))


def _start(
    time: float, drive: DriveRecord | None, config: ControllerConfig | None, is_first: bool, notes: list[str]
) -> tuple[Start | None, ControllerConfig | None]:
    """Return the start before a tick, or the configuration that changed at it."""
    if drive is None:
        notes.append(_NO_DRIVE)
        return Start(None, time, is_reset=False), None
    if not (drive.starts or is_first):
        return None, config
    if is_first and config is not None and time - drive.t0 > _LATE_START * config.sample_time:
        notes.append(
            f"The log begins {time - drive.t0:.1f} s after the start of the drive, without the estimate at that time: "
            "commands may differ for some seconds."
        )
    reference = None if drive.reference is None else TabledTrajectory.read(drive.reference)
    # A recording that starts mid-drive has no state to resume from.
    start = Start(reference, drive.t0, drive.reset, goes_on=drive.goes_on and not is_first)
    return start, None if drive.starts else config


def _numbered(records: Sequence[Any]) -> list[tuple[tuple[int, int], Any]]:
    """Pair each record with its activation of the node and its drive; numbers restart with an activation."""
    activation, previous, numbered = 0, 0, []
    for record in records:
        number = record.number if isinstance(record, DriveRecord) else record.drive
        activation += number < previous
        previous = number
        numbered.append(((activation, number), record))
    return numbered
