"""Logs read, judged, and divided into records to identify from and records held out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from diffdrive_mpc.models.checked_yaml import ConfigError, StrictModel, check
from diffdrive_mpc.models.identification.settings import identification_settings
from diffdrive_mpc.models.identification.spikes import without_spikes
from diffdrive_mpc.models.logs import Finding, Log, Record, read_log
from diffdrive_mpc.models.output_error.experiment import YawSource
from diffdrive_mpc.models.robot import SampleTime

_SIGNALS = {"twist": "fresh_twist", "yaw_rate": "fresh_yaw_rate", "wheels": "fresh_twist"}


class OptionError(ConfigError):
    """An option of `identify` cannot be used.

    Attributes
    ----------
    option, rest
        Its name as an argument, and the rest of the message.
    """

    def __init__(self, option: str, rest: str) -> None:
        super().__init__(option + rest)
        self.option, self.rest = option, rest


class _Clock(StrictModel):
    """What a controller for the log would be run at."""

    sample_time: SampleTime


@dataclass(frozen=True)
class LogData:
    """What a model is identified from and tried on.

    Attributes
    ----------
    train, validation
        Records, all with one sample time; none of the second is in the first.
    logs
        Names of the logs.
    held_out
        How the validation records were chosen, in words.
    yaw
        Whether omega is the gyro's or, without one, the encoders'.
    findings
        Of all logs, notes and warnings.
    warnings
        What was left out of the logs.
    """

    train: tuple[Record, ...]
    validation: tuple[Record, ...]
    logs: tuple[str, ...]
    held_out: str
    yaw: YawSource
    findings: tuple[Finding, ...]
    warnings: tuple[str, ...]


def read_data(
    logs: Sequence[Path],
    validate: Sequence[Path],
    *,
    mapping: str | Path | None,
    fit_share: float,
    wheels: bool,
    on_findings: Callable[[Sequence[Finding]], None],
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

    Raises
    ------
    models.checked_yaml.ConfigError
        If a log cannot be read, would give a wrong model, has no sample time of a controller, or a signal is missing
        from all of them.
    """
    low, high = identification_settings().shares
    if not low <= fit_share <= high:
        raise OptionError("fit_share", f" {fit_share:g}: give {low:g} to {high:g}")
    twice = [path for path in (*logs, *validate) if [*logs, *validate].count(path) > 1]
    if twice:
        raise ConfigError(f"{twice[0]}: this log is given twice; a model must not be tried on what it was made from")
    read: list[Log] = []
    for path in (*logs, *validate):
        log = read_log(path, mapping, read[0].records[0].dt if read else None)
        on_findings([finding for finding in log.findings if finding.severity != "error"])
        log.require_sound()
        records, spikes = without_spikes(log.records, log.name)
        on_findings(spikes)
        read.append(replace(log, records=tuple(records), findings=(*log.findings, *spikes)))
    fitted, tried = read[: len(logs)], read[len(logs) :]
    has_gyro = any(record.yaw_rate is not None for log in fitted for record in log.records)
    yaw: YawSource = "gyro" if has_gyro else "encoders"
    needed = ("twist", *(["yaw_rate"] if yaw == "gyro" else []), *(["wheels"] if wheels else []))
    if tried:
        train = [record for log in fitted for record in log.records]
        validation = [record for log in tried for record in log.records]
        held_out = f"logs of their own: {', '.join(log.name for log in tried)}"
    else:
        halves = [divide(log.records, fit_share) for log in fitted]
        train = [record for first, _ in halves for record in first]
        validation = [record for _, last in halves for record in last]
        held_out = f"the last {100 * (1 - fit_share):.0f} % of the rows of each log"
    warnings: list[str] = []
    data = LogData(
        train=_usable(train, needed, "to identify from", warnings),
        validation=_usable(validation, needed, "to validate on", warnings),
        logs=tuple(log.name for log in fitted),
        held_out=held_out,
        yaw=yaw,
        findings=tuple(finding for log in read for finding in log.findings),
        warnings=tuple(warnings),
    )
    check(_Clock, {"sample_time": data.train[0].dt}, data.logs[0])
    return data


def divide(records: Sequence[Record], share: float) -> tuple[list[Record], list[Record]]:
    """The first `share` [-] of all rows, and the rest; the record in which the cut falls is cut."""
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


def _usable(records: Sequence[Record], needed: Sequence[str], use: str, warnings: list[str]) -> tuple[Record, ...]:
    """Records with enough readings of every signal; `warnings` gets a line for each that is left out."""
    least = identification_settings().fewest_readings
    kept: list[Record] = []
    lacking = ""
    for record in records:
        missing = next((name for name in needed if _readings(record, name) < least), None)
        if missing is None:
            kept.append(record)
            continue
        lacking = f"{record.name}: {_readings(record, missing)} readings of {missing}, fewer than {least}"
        warnings.append(f"{lacking}; the stretch is not used {use}")
    if not kept:
        raise ConfigError(f"nothing {use}: {lacking or 'no rows are left'}; log that signal, or for longer")
    return tuple(kept)


def _readings(record: Record, name: str) -> int:
    mask = getattr(record, _SIGNALS[name])
    return 0 if getattr(record, name) is None or mask is None else int(mask.sum())
