"""Reading, checking and division of logs into training and validation records."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from diffdrive_mpc.models.checked_yaml import ConfigError, StrictModel, check
from diffdrive_mpc.models.doubt import Doubt
from diffdrive_mpc.models.identification.settings import identification_settings
from diffdrive_mpc.models.logs import Finding, Log, Record, read_log
from diffdrive_mpc.models.logs.diagnosis import compare_logs
from diffdrive_mpc.models.logs.mapping import LogMapping, load_mapping
from diffdrive_mpc.models.logs.pose_twist import with_twist_of_poses
from diffdrive_mpc.models.logs.record import Topics, refuse
from diffdrive_mpc.models.output_error.experiment import YawSource
from diffdrive_mpc.models.robot import SampleTime

if TYPE_CHECKING:
    from diffdrive_mpc.models.identification.advice import Advice


class OptionError(ConfigError):
    """Error for an unusable option of `identify`.

    Attributes
    ----------
    option, rest
        Name of the option as an argument, and the remaining message.
    """

    def __init__(self, option: str, rest: str) -> None:
        super().__init__(option + rest)
        self.option, self.rest = option, rest


class _Clock(StrictModel):
    """Sample time of a controller for the log."""

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
        Sensor of omega: the gyro if the log has one, else the encoders, or the poses if there are no encoders.
    findings
        Notes and warnings of all logs; with `force` also errors.
    warnings
        Parts of the logs that are not used.
    stated_track
        Track that the mapping states [m]; None if it states none.
    sensors
        Delays, scales and signs of the sensors, by input, for the robot's configuration.
    topics
        Topic and message type by stream, for bags.
    advice
        Mapping that improves the prediction of the logs; None if there is none.
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
    most_rows: int | None = None,
) -> LogData:
    """Read all logs and divide them.

    Parameters
    ----------
    logs
        Logs to identify from.
    validate
        Validation logs; by default the last part of each of `logs`.
    mapping
        Mapping of all logs, as for `models.logs.read_log`.
    fit_share
        Share of the rows of each log before that last part [-].
    wheels
        Whether the model is identified from wheel speeds.
    on_findings
        Called with notes and warnings of each log after it is read, also if an error is raised next.
    on_log
        Called with each log before its findings.
    force
        Whether to use logs despite findings of severity "error".
    most_rows
        Maximum number of training rows and of validation rows, selected where the commands change most; None for all.

    Raises
    ------
    models.checked_yaml.ConfigError
        If a log cannot be read or would give a wrong model, if its sample time is no sample time of a controller, or if
        a signal is missing in all logs.
    """
    _check_selection(logs, validate, fit_share)
    loaded = mapping if mapping is None or isinstance(mapping, LogMapping) else load_mapping(mapping)
    geometry = None if loaded is None else loaded.wheels

    def admit(findings: Sequence[Finding]) -> None:
        on_findings([finding for finding in findings if force or finding.severity != "error"])
        if not force:
            refuse(findings)

    read = _read_alike((*logs, *validate), mapping, on_log or (lambda _: None), admit)
    records = [record for log in read for record in log.records]
    by_poses = not any(record.twist is not None for record in records) and any(r.pose is not None for r in records)
    if by_poses:
        read = [replace(log, records=with_twist_of_poses(log.records)) for log in read]
    training, validating = read[: len(logs)], read[len(logs) :]
    has_gyro = any(record.yaw_rate is not None for log in training for record in log.records)
    yaw: YawSource = "gyro" if has_gyro else "poses" if by_poses else "encoders"
    if by_poses:
        subject = "v is" if has_gyro else "v and omega are"
        on_findings([Finding("poses_alone", "note", "encoders", f"the log has none: {subject} computed from poses")])
    needed = ("twist", *(["yaw_rate"] if has_gyro else []), *(["wheels"] if wheels else []))
    train, validation, held_out = _divide_logs(training, validating, fit_share)
    omitted: list[Finding] = []
    if most_rows is not None:
        omitted = _note_omitted({"identification": train, "validation": validation}, most_rows)
        train, validation = most_informative(train, most_rows), most_informative(validation, most_rows)
    on_findings(omitted)
    warnings: list[Doubt] = []
    train_used = usable(train, needed, "to identify from", warnings)
    validation_used = usable(validation, needed, "to validate on", warnings)
    comparison = compare_logs(training)
    admit(comparison)
    data = LogData(
        train=train_used,
        validation=validation_used,
        logs=tuple(log.name for log in training),
        held_out=held_out,
        yaw=yaw,
        findings=(*(finding for log in read for finding in log.findings), *comparison, *omitted),
        warnings=tuple(warnings),
        stated_track=None if geometry is None else geometry.track,
        topics=training[0].topics,
    )
    check(_Clock, {"sample_time": data.train[0].dt}, data.logs[0])
    return data


def _check_selection(logs: Sequence[Path], validate: Sequence[Path], fit_share: float) -> None:
    low, high = identification_settings().shares
    if not low <= fit_share <= high:
        raise OptionError("fit_share", f" {fit_share:g}: give {low:g} to {high:g}")
    twice = [path for path in (*logs, *validate) if [*logs, *validate].count(path) > 1]
    if twice:
        raise ConfigError(f"{twice[0]}: this log is given twice; a model must not be tested on its training data")


def _read_alike(
    paths: Sequence[Path],
    mapping: str | Path | LogMapping | None,
    on_log: Callable[[Log], None],
    admit: Callable[[Sequence[Finding]], None],
) -> list[Log]:
    """Read the logs at the sample time of the first; `admit` raises ConfigError for findings that exclude a log."""
    read: list[Log] = []
    for path in paths:
        log = read_log(path, mapping, read[0].records[0].dt if read else None)
        on_log(log)
        admit(log.findings)
        read.append(log)
    return read


def _divide_logs(
    training: Sequence[Log], validating: Sequence[Log], fit_share: float
) -> tuple[list[Record], list[Record], str]:
    """Return training records, validation records, and a description of the latter."""
    if validating:
        train, validation = ([record for log in logs for record in log.records] for logs in (training, validating))
        return train, validation, f"separate logs: {', '.join(log.name for log in validating)}"
    halves = [divide(log.records, fit_share) for log in training]
    train, validation = ([record for parts in part for record in parts] for part in zip(*halves, strict=True))
    return train, validation, f"the last {100 * (1 - fit_share):.0f} % of the rows of each log"


def _note_omitted(parts: Mapping[str, Sequence[Record]], max_rows: int) -> list[Finding]:
    """Return a note for each part with more than `max_rows` rows."""
    counts = {use: sum(len(record.command) for record in records) for use, records in parts.items()}
    words = "{} of {} rows are used, the parts in which the commands change most"
    return [
        Finding("subset", "note", use, words.format(max_rows, rows)) for use, rows in counts.items() if rows > max_rows
    ]


def divide(records: Sequence[Record], share: float) -> tuple[list[Record], list[Record]]:
    """Divide records into the first `share` [-] of all rows and the rest; cut the record at the boundary."""
    remaining = round(share * sum(len(record.command) for record in records))
    first: list[Record] = []
    last: list[Record] = []
    for record in records:
        count = len(record.command)
        if remaining >= count:
            first.append(record)
        elif remaining <= 0:
            last.append(record)
        else:
            first.append(record.part(0, remaining))
            last.append(record.part(remaining, count))
        remaining -= count
    return first, last


def most_informative(records: Sequence[Record], max_rows: int) -> list[Record]:
    """Select at most `max_rows` rows, in order, from the parts in which the commands change most."""
    if sum(len(record.command) for record in records) <= max_rows:
        return list(records)
    commands = np.concatenate([record.command for record in records])
    scale = np.maximum(commands.std(axis=0), 1e-12)
    span = max(1, round(identification_settings().part_time / records[0].dt))
    parts = [(i, first) for i, record in enumerate(records) for first in range(0, len(record.command), span)]
    scores = [
        float((np.abs(np.diff(records[i].command[first : first + span], axis=0)) / scale).sum()) for i, first in parts
    ]
    selected: list[tuple[int, int]] = []
    remaining = max_rows
    for index in np.argsort(-np.array(scores), kind="stable"):
        i, first = parts[index]
        count = min(span, len(records[i].command) - first)
        if count <= remaining:
            selected.append((i, first))
            remaining -= count
    return [records[i].part(first, min(first + span, len(records[i].command))) for i, first in sorted(selected)]


def usable(records: Sequence[Record], needed: Sequence[str], use: str, warnings: list[Doubt]) -> tuple[Record, ...]:
    """Select the records with enough readings of every signal; append a doubt to `warnings` for each other record.

    Raises
    ------
    models.checked_yaml.ConfigError
        If no record has enough readings.
    """
    min_readings = identification_settings().fewest_readings
    selected: list[Record] = []
    lacking = ""
    for record in records:
        missing = next((name for name in needed if _count_readings(record, name) < min_readings), None)
        if missing is None:
            selected.append(record)
            continue
        lacking = f"{record.name}: {_count_readings(record, missing)} readings of {missing}, fewer than {min_readings}"
        warnings.append(Doubt("stretch left out", f"{lacking}; the stretch is not used {use}"))
    if not selected:
        raise ConfigError(f"nothing {use}: {lacking or 'no rows are left'}; log that signal, or record a longer log")
    return tuple(selected)


def _count_readings(record: Record, name: str) -> int:
    fresh = record.fresh(name)
    return 0 if fresh is None else int(fresh.sum())
