"""Recorded drive of the node, from the records that it publishes at each tick; its replay is exact to the last bit."""

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
        Folder for files of models that are not shipped.
    trusted
        Folders whose files a configuration may name. None omits configurations that name other files, because the
        replay uses a configuration of the command line.
    """

    log: Path
    scratch: Path
    trusted: Sequence[Path] | None = ()

    def read(self, config: Mapping[str, Any], model: str) -> ControllerConfig | None:
        """Return the configuration; `model` is the text of its model file, empty for a shipped model.

        Returns None for a configuration to omit. Raises the errors of `config_from_log`.
        """
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
    """Read the drive from the lines of the topics ~/tick and ~/drive.

    Raises ConfigError if a line is not a record, there is no tick, or a configuration names a file that is not trusted.
    """
    try:
        tick_records = _with_drive_keys([TickRecord.read(line) for line in ticks])
        drive_records = dict(_with_drive_keys([DriveRecord.read(line) for line in drives]))
    except TickRecordError as error:
        raise ConfigError(f"{path}: {error}") from error
    if not tick_records:
        raise ConfigError(f"{path}: the log holds no tick of the controller; record for longer")
    drive_configs = {key: configs.read(drive.config, drive.model) for key, drive in drive_records.items()}
    recorded_ticks: list[RecordedTick] = []
    notes: list[str] = []
    current: tuple[int, int] | None = None
    for key, record in tick_records:
        start, config = None, None
        if key != current:
            is_first, current = current is None, key
            start, config = _start(record.time, drive_records.get(key), drive_configs.get(key), is_first, notes)
        hold = None if record.hold is None else Hold(*record.hold)
        outcome = (record.command, record.mode, record.message)
        recorded_ticks.append(
            RecordedTick(record.time, record.measurement, *outcome, hold, start, config, record.stopped_after)
        )
    numbers = np.diff([record.number for _, record in tick_records])
    if missing := int((numbers[numbers > 1] - 1).sum()):
        notes.append(f"{missing} ticks are missing: commands differ after each gap until the estimate has settled.")
    return Recording(path.name, tuple(recorded_ticks), next(iter(drive_configs.values()), None), tuple(notes))


def _start(
    time: float, drive: DriveRecord | None, config: ControllerConfig | None, is_first: bool, notes: list[str]
) -> tuple[Start | None, ControllerConfig | None]:
    """Return the start before a tick, or the configuration that applies from the tick on."""
    if drive is None:
        notes.append(_NO_DRIVE)
        return Start(None, time, is_reset=False), None
    if not (drive.starts or is_first):
        return None, config
    if is_first and config is not None and time - drive.t0 > _LATE_START * config.sample_time:
        notes.append(
            f"The log starts {time - drive.t0:.1f} s after the start of the drive and lacks the estimate of that time: "
            "commands may differ for some seconds."
        )
    reference = None if drive.reference is None else TabledTrajectory.read(drive.reference)
    # A recording that starts mid-drive has no state to resume from.
    start = Start(reference, drive.t0, drive.reset, goes_on=drive.goes_on and not is_first)
    return start, None if drive.starts else config


def _with_drive_keys(records: Sequence[Any]) -> list[tuple[tuple[int, int], Any]]:
    """Pair each record with a key: activation of the node, and number of the drive in this activation."""
    activation, previous, pairs = 0, 0, []
    for record in records:
        number = record.number if isinstance(record, DriveRecord) else record.drive
        activation += number < previous
        previous = number
        pairs.append(((activation, number), record))
    return pairs
