"""Reading of logs, checks, and division into training and validation records."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from diffdrive_mpc.models.checked_yaml import ConfigError, StrictModel, check
from diffdrive_mpc.models.doubt import Doubt
from diffdrive_mpc.models.errors import checked_number
from diffdrive_mpc.models.identification.settings import identification_settings
from diffdrive_mpc.models.logs import Finding, Log, Record, read_log
from diffdrive_mpc.models.logs.diagnosis import compare_logs
from diffdrive_mpc.models.logs.mapping import LogMapping, load_mapping
from diffdrive_mpc.models.logs.pose_twist import with_twist_of_poses
from diffdrive_mpc.models.logs.record import Topics, raise_on_error
from diffdrive_mpc.models.output_error.experiment import YawSource
from diffdrive_mpc.models.robot import SampleTime

if TYPE_CHECKING:
    from diffdrive_mpc.models.identification.advice import Advice


class OptionError(ConfigError):
    """Error for an unusable option of `identify`.

    Attributes
    ----------
    option, rest
        Name of the option as an argument, and rest of the message.
    """

    def __init__(self, option: str, rest: str) -> None:
        super().__init__(option + rest)
        self.option, self.rest = option, rest


class _Clock(StrictModel):
    """Sample time of the log, checked against the range of a controller."""

    sample_time: SampleTime


@dataclass(frozen=True)
class LogData:
    """Data for identification and validation.

    Attributes
    ----------
    train, validation
        Disjoint records with a common sample time.
    logs
        Names of the logs.
    held_out
        Description of the validation records.
    yaw
        Sensor of omega: the gyro, the encoders if there is no gyro, or the poses if there are no encoders.
    findings
        Notes and warnings of all logs; with `force` also errors.
    warnings
        Doubts about parts of the logs that are not used.
    stated_track
        Track stated by the mapping [m]; None if the mapping states no track.
    sensors
        Delays, scales and signs of the sensors, by input, for the robot's configuration.
    topics
        Topic and message type by stream, for bags.
    advice
        Mapping that improves the prediction of the logs; None if no proposed mapping improves it.
    """

    train: tuple[Record, ...]
    validation: tuple[Record, ...]
    logs: tuple[str, ...]
    held_out: str
    yaw: YawSource
    findings: tuple[Finding, ...]
    warnings: tuple[Doubt, ...]
    stated_track: float | None = None
    sensors: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    topics: Topics = field(default_factory=dict)
    advice: Advice | None = None


def read_data(
    logs: Sequence[Path],
    validate: Sequence[Path],
    *,
    mapping: str | Path | LogMapping | None,
    fit_share: float,
    wheels: bool,
    on_findings: Callable[[Sequence[Finding]], None],
    on_log: Callable[[Log], None] | None = None,
    force: bool = False,
    max_rows: int | None = None,
) -> LogData:
    """Read all logs and divide them into training and validation records.

    Parameters
    ----------
    logs
        Logs for the identification.
    validate
        Validation logs; by default the last part of each of `logs`.
    mapping
        Mapping of all logs, as in `models.logs.read_log`.
    fit_share
        Share of the rows of each log before the validation part [-].
    wheels
        True if the model is identified from wheel speeds.
    on_findings
        Function that is called with notes and warnings of each log after it is read, even if an error follows.
    on_log
        Function that is called with each log, before `on_findings`.
    force
        True to use logs despite findings of severity "error".
    max_rows
        Maximum number of training rows and of validation rows, selected where the commands change most; None for all.

    Raises
    ------
    models.checked_yaml.ConfigError
        If a log cannot be read or leads to a wrong model, if its sample time is outside the range of a controller, or
        if a signal is missing in all logs.
    """
    _check_share(fit_share)
    loaded_mapping = mapping if mapping is None or isinstance(mapping, LogMapping) else load_mapping(mapping)
    geometry = None if loaded_mapping is None else loaded_mapping.wheels

    def report_findings(findings: Sequence[Finding]) -> None:
        on_findings([finding for finding in findings if force or finding.severity != "error"])
        if not force:
            raise_on_error(findings)

    all_logs = _read_logs((*logs, *validate), mapping, on_log or (lambda _: None), report_findings)
    records = [record for log in all_logs for record in log.records]
    uses_poses = not any(record.twist is not None for record in records) and any(r.pose is not None for r in records)
    if uses_poses:
        all_logs = [replace(log, records=with_twist_of_poses(log.records)) for log in all_logs]
    training_logs, validation_logs = all_logs[: len(logs)], all_logs[len(logs) :]
    has_gyro = any(record.yaw_rate is not None for log in training_logs for record in log.records)
    yaw: YawSource = "gyro" if has_gyro else "poses" if uses_poses else "encoders"
    if uses_poses:
        subject = "v is" if has_gyro else "v and omega are"
        on_findings([Finding("poses_alone", "note", "encoders", f"not in the log: {subject} computed from poses")])
    signals = ("twist", *(["yaw_rate"] if has_gyro else []), *(["wheels"] if wheels else []))
    train, validation, held_out = _divide_logs(training_logs, validation_logs, fit_share)
    omitted: list[Finding] = []
    if max_rows is not None:
        omitted = _note_omitted({"identification": train, "validation": validation}, max_rows)
        train, validation = most_informative(train, max_rows), most_informative(validation, max_rows)
    on_findings(omitted)
    warnings: list[Doubt] = []
    usable_train = select_usable(train, signals, "for identification", warnings)
    usable_validation = select_usable(validation, signals, "for validation", warnings)
    comparison = compare_logs(training_logs)
    report_findings(comparison)
    data = LogData(
        train=usable_train,
        validation=usable_validation,
        logs=tuple(log.name for log in training_logs),
        held_out=held_out,
        yaw=yaw,
        findings=(*(finding for log in all_logs for finding in log.findings), *comparison, *omitted),
        warnings=tuple(warnings),
        stated_track=None if geometry is None else geometry.track,
        topics=training_logs[0].topics,
    )
    check(_Clock, {"sample_time": data.train[0].dt}, data.logs[0])
    return data


def _check_share(fit_share: float) -> None:
    low, high = identification_settings().shares
    if not low <= checked_number("fit_share", fit_share, "give a share such as 0.6") <= high:
        raise OptionError("fit_share", f" {fit_share:g}: give {low:g} to {high:g}")


def _read_logs(
    paths: Sequence[Path],
    mapping: str | Path | LogMapping | None,
    on_log: Callable[[Log], None],
    report_findings: Callable[[Sequence[Finding]], None],
) -> list[Log]:
    """Read the logs with the sample time of the first log.

    Raise ConfigError for two logs with the same data; `report_findings` raises ConfigError for unusable logs.
    """
    all_logs: list[Log] = []
    paths_by_data: dict[tuple[bytes, ...], Path] = {}
    for path in paths:
        log = read_log(path, mapping, all_logs[0].records[0].dt if all_logs else None)
        data = _measured_data(log)
        if data in paths_by_data:
            same = f"this log is given twice, it has the data of {paths_by_data[data]}"
            raise ConfigError(f"{path}: {same}; remove one, since validation data must not be training data")
        paths_by_data[data] = path
        on_log(log)
        report_findings(log.findings)
        all_logs.append(log)
    return all_logs


def _measured_data(log: Log) -> tuple[bytes, ...]:
    """Return commands and readings of a log, by which copies of a file are recognised."""
    signals = [
        getattr(record, name) for record in log.records for name in ("command", "twist", "wheels", "yaw_rate", "pose")
    ]
    return tuple(signal.tobytes() for signal in signals if signal is not None)


def _divide_logs(
    training_logs: Sequence[Log], validation_logs: Sequence[Log], fit_share: float
) -> tuple[list[Record], list[Record], str]:
    """Return training records, validation records, and a description of the validation records."""
    if validation_logs:
        parts = (training_logs, validation_logs)
        train, validation = ([record for log in logs for record in log.records] for logs in parts)
        return train, validation, f"separate logs: {', '.join(log.name for log in validation_logs)}"
    divisions = [divide(log.records, fit_share) for log in training_logs]
    train, validation = ([record for parts in part for record in parts] for part in zip(*divisions, strict=True))
    return train, validation, f"the last {100 * (1 - fit_share):.0f} % of the rows of each log"


def _note_omitted(parts: Mapping[str, Sequence[Record]], max_rows: int) -> list[Finding]:
    """Return a note for each part with more than `max_rows` rows."""
    counts = {use: sum(len(record.command) for record in records) for use, records in parts.items()}
    text = "{} of {} rows are used: the parts with the largest changes of the commands"
    return [
        Finding("subset", "note", use, text.format(max_rows, rows)) for use, rows in counts.items() if rows > max_rows
    ]


def divide(records: Sequence[Record], share: float) -> tuple[list[Record], list[Record]]:
    """Divide records into the first `share` [-] of all rows and the rest; a record at the boundary is cut."""
    remaining = round(share * sum(len(record.command) for record in records))
    head: list[Record] = []
    tail: list[Record] = []
    for record in records:
        count = len(record.command)
        if remaining >= count:
            head.append(record)
        elif remaining <= 0:
            tail.append(record)
        else:
            head.append(record.part(0, remaining))
            tail.append(record.part(remaining, count))
        remaining -= count
    return head, tail


def most_informative(records: Sequence[Record], max_rows: int) -> list[Record]:
    """Select at most `max_rows` rows, in order, from the parts with the largest changes of the commands."""
    if sum(len(record.command) for record in records) <= max_rows:
        return list(records)
    commands = np.concatenate([record.command for record in records])
    scale = np.maximum(commands.std(axis=0), 1e-12)
    # A part longer than the maximum would never be selected.
    span = min(max_rows, max(1, round(identification_settings().part_time / records[0].dt)))
    parts = [(i, start) for i, record in enumerate(records) for start in range(0, len(record.command), span)]
    scores = [
        float((np.abs(np.diff(records[i].command[start : start + span], axis=0)) / scale).sum()) for i, start in parts
    ]
    selected: list[tuple[int, int]] = []
    remaining = max_rows
    for index in np.argsort(-np.array(scores), kind="stable"):
        i, start = parts[index]
        count = min(span, len(records[i].command) - start)
        if count <= remaining:
            selected.append((i, start))
            remaining -= count
    return [records[i].part(start, min(start + span, len(records[i].command))) for i, start in sorted(selected)]


_SENSORS = {"twist": "encoders or poses", "yaw_rate": "a gyro"}
"""Sensors that measure a signal of a record, in messages."""


def select_usable(records: Sequence[Record], names: Sequence[str], use: str, doubts: list[Doubt]) -> tuple[Record, ...]:
    """Select the records with enough readings of the signals `names`; append a doubt to `doubts` for each other record.

    Raises
    ------
    models.checked_yaml.ConfigError
        If no record has enough readings.
    """
    min_readings = identification_settings().min_readings
    selected: list[Record] = []
    reason = ""
    for record in records:
        missing = next((name for name in names if _count_readings(record, name) < min_readings), None)
        if missing is None:
            selected.append(record)
            continue
        count, sensor = _count_readings(record, missing), _SENSORS.get(missing, missing)
        reason = f"{record.name}: {count} readings of {sensor}, fewer than {min_readings}"
        doubts.append(Doubt("stretch left out", f"{reason}; the stretch is not used {use}"))
    if not selected:
        raise ConfigError(
            f"no data {use}: {reason or 'no rows remain'}; add the sensor to the mapping, or record longer"
        )
    return tuple(selected)


def _count_readings(record: Record, name: str) -> int:
    fresh = record.fresh(name)
    return 0 if fresh is None else int(fresh.sum())
