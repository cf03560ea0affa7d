"""Logs read, judged, and divided into records to identify from and records held out."""

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
    """An option of `identify` cannot be used.

    Attributes
    ----------
    option, rest
        Name of the option as an argument, and the rest of the message.
    """

    def __init__(self, option: str, rest: str) -> None:
        super().__init__(option + rest)
        self.option, self.rest = option, rest


class _Clock(StrictModel):
    """Clock of a controller for the log."""

    sample_time: SampleTime


@dataclass(frozen=True)
class LogData:
    """Data for identification and validation.

    Attributes
    ----------
    train, validation
        Records, all with one sample time; none of the second is in the first.
    logs
        Names of the logs.
    held_out
        Selection of the validation records, in words.
    yaw
        Sensor of omega: the gyro or, without one, the encoders, or the poses where they are alone.
    findings
        Findings of all logs, notes and warnings; with `force` errors, too.
    warnings
        Parts that were left out of the logs.
    stated_track
        Track that the mapping states [m]; None where it states none.
    sensors
        Differences between readings and motion, by input, for the robot's configuration.
    topics
        Topic and type of message by stream, of logs that are bags.
    advice
        A mapping with which the logs are predicted better; None where none is known.
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
        Logs to try the model on; without any, the last part of each of `logs`.
    mapping
        Mapping of all of them, as `models.logs.read_log` takes it.
    fit_share
        Part of the rows of each log that comes before that last part [-].
    wheels
        Whether the model is identified from the speeds of the wheels.
    on_findings
        Called with notes and warnings of each log once it is read, also when an error of it is raised next.
    on_log
        Called with each log before its findings.
    force
        Whether logs are used although findings of severity "error" speak against it.
    most_rows
        Largest number of rows that are used of either part, those in which the commands change most; None for all.

    Raises
    ------
    models.checked_yaml.ConfigError
        If a log cannot be read, would give a wrong model, has no sample time of a controller, or a signal is missing
        from all of them.
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
    fitted, tried = read[: len(logs)], read[len(logs) :]
    has_gyro = any(record.yaw_rate is not None for log in fitted for record in log.records)
    yaw: YawSource = "gyro" if has_gyro else "poses" if by_poses else "encoders"
    if by_poses:
        subject = "v is" if has_gyro else "v and omega are"
        on_findings([Finding("poses_alone", "note", "encoders", f"the log has none: {subject} computed from poses")])
    needed = ("twist", *(["yaw_rate"] if has_gyro else []), *(["wheels"] if wheels else []))
    train, validation, held_out = _divided(fitted, tried, fit_share)
    spare: list[Finding] = []
    if most_rows is not None:
        spare = _spare({"identification": train, "validation": validation}, most_rows)
        train, validation = most_informative(train, most_rows), most_informative(validation, most_rows)
    on_findings(spare)
    warnings: list[Doubt] = []
    train_used = usable(train, needed, "to identify from", warnings)
    validation_used = usable(validation, needed, "to validate on", warnings)
    together = compare_logs(fitted)
    admit(together)
    data = LogData(
        train=train_used,
        validation=validation_used,
        logs=tuple(log.name for log in fitted),
        held_out=held_out,
        yaw=yaw,
        findings=(*(finding for log in read for finding in log.findings), *together, *spare),
        warnings=tuple(warnings),
        stated_track=None if geometry is None else geometry.track,
        topics=fitted[0].topics,
    )
    check(_Clock, {"sample_time": data.train[0].dt}, data.logs[0])
    return data


def _check_selection(logs: Sequence[Path], validate: Sequence[Path], fit_share: float) -> None:
    low, high = identification_settings().shares
    if not low <= fit_share <= high:
        raise OptionError("fit_share", f" {fit_share:g}: give {low:g} to {high:g}")
    twice = [path for path in (*logs, *validate) if [*logs, *validate].count(path) > 1]
    if twice:
        raise ConfigError(
            f"{twice[0]}: this log is given twice; a model must not be tested on its own identification data"
        )


def _read_alike(
    paths: Sequence[Path],
    mapping: str | Path | LogMapping | None,
    on_log: Callable[[Log], None],
    admit: Callable[[Sequence[Finding]], None],
) -> list[Log]:
    """Read the logs at the sample time of the first; `admit` refuses findings that rule one out."""
    read: list[Log] = []
    for path in paths:
        log = read_log(path, mapping, read[0].records[0].dt if read else None)
        on_log(log)
        admit(log.findings)
        read.append(log)
    return read


def _divided(fitted: Sequence[Log], tried: Sequence[Log], fit_share: float) -> tuple[list[Record], list[Record], str]:
    """Divide logs into records to identify from and records held out; describe the latter in words."""
    if tried:
        train, validation = ([record for log in logs for record in log.records] for logs in (fitted, tried))
        return train, validation, f"logs of their own: {', '.join(log.name for log in tried)}"
    halves = [divide(log.records, fit_share) for log in fitted]
    train, validation = ([record for parts in part for record in parts] for part in zip(*halves, strict=True))
    return train, validation, f"the last {100 * (1 - fit_share):.0f} % of the rows of each log"


def _spare(parts: Mapping[str, Sequence[Record]], most: int) -> list[Finding]:
    """Return a note for each part with more than `most` rows."""
    counts = {use: sum(len(record.command) for record in records) for use, records in parts.items()}
    words = "{} of {} rows are used, the parts in which the commands change most"
    return [Finding("subset", "note", use, words.format(most, rows)) for use, rows in counts.items() if rows > most]


def divide(records: Sequence[Record], share: float) -> tuple[list[Record], list[Record]]:
    """Divide records into the first `share` [-] of all rows and the rest; cut the record between them."""
    left = round(share * sum(len(record.command) for record in records))
    first: list[Record] = []
    last: list[Record] = []
    for record in records:
        count = len(record.command)
        if left >= count:
            first.append(record)
        elif left <= 0:
            last.append(record)
        else:
            first.append(record.part(0, left))
            last.append(record.part(left, count))
        left -= count
    return first, last


def most_informative(records: Sequence[Record], most: int) -> list[Record]:
    """Select at most `most` rows, in order, from the minutes in which the commands change most."""
    if sum(len(record.command) for record in records) <= most:
        return list(records)
    commands = np.concatenate([record.command for record in records])
    scale = np.maximum(commands.std(axis=0), 1e-12)
    span = max(1, round(identification_settings().part_time / records[0].dt))
    parts = [(i, first) for i, record in enumerate(records) for first in range(0, len(record.command), span)]
    scores = [
        float((np.abs(np.diff(records[i].command[first : first + span], axis=0)) / scale).sum()) for i, first in parts
    ]
    taken: list[tuple[int, int]] = []
    left = most
    for index in np.argsort(-np.array(scores), kind="stable"):
        i, first = parts[index]
        count = min(span, len(records[i].command) - first)
        if count <= left:
            taken.append((i, first))
            left -= count
    return [records[i].part(first, min(first + span, len(records[i].command))) for i, first in sorted(taken)]


def usable(records: Sequence[Record], needed: Sequence[str], use: str, warnings: list[Doubt]) -> tuple[Record, ...]:
    """Select records with enough readings of every signal; append a line to `warnings` for each one left out.

    Raises
    ------
    models.checked_yaml.ConfigError
        If none is left.
    """
    least = identification_settings().fewest_readings
    selected: list[Record] = []
    lacking = ""
    for record in records:
        missing = next((name for name in needed if _readings(record, name) < least), None)
        if missing is None:
            selected.append(record)
            continue
        lacking = f"{record.name}: {_readings(record, missing)} readings of {missing}, fewer than {least}"
        warnings.append(Doubt("stretch left out", f"{lacking}; the stretch is not used {use}"))
    if not selected:
        raise ConfigError(f"nothing {use}: {lacking or 'no rows are left'}; log that signal, or for longer")
    return tuple(selected)


def _readings(record: Record, name: str) -> int:
    fresh = record.fresh(name)
    return 0 if fresh is None else int(fresh.sum())
