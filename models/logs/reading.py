"""Reading of a log from a file: splitting into stretches, resampling and checks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.logs.bags import is_bag, read_bag
from diffdrive_mpc.models.logs.check_settings import CheckSettings, check_settings
from diffdrive_mpc.models.logs.csv_log import read_csv
from diffdrive_mpc.models.logs.diagnosis import diagnose
from diffdrive_mpc.models.logs.diagnosis.readings import (
    check_dead_readings,
    check_period,
    check_publishers,
    check_resolution,
    without_spikes,
)
from diffdrive_mpc.models.logs.diagnosis.streams import streams_of
from diffdrive_mpc.models.logs.drive_log.reader import is_drive_log, read_drive
from diffdrive_mpc.models.logs.headings import with_headings
from diffdrive_mpc.models.logs.mapping import LogMapping, load_mapping
from diffdrive_mpc.models.logs.mapping_changes import base_mapping, stated_changes
from diffdrive_mpc.models.logs.record import Finding, Log, Record, raise_on_error
from diffdrive_mpc.models.logs.record_checks import check_commands, check_sensors, check_timing, gap_finding
from diffdrive_mpc.models.logs.sampling import RawLog, resample, split_at_pauses, usual_step


def read_log(
    path: str | Path,
    mapping: str | Path | LogMapping | None = None,
    sample_time: float | None = None,
    *,
    diagnosed: bool = True,
) -> Log:
    """Read a log of a robot.

    Parameters
    ----------
    path
        A CSV file, or a ROS 2 bag as a folder or as one .mcap or .db3 file.
    mapping
        Name of a shipped mapping, path of a mapping file, or its content. None for a log of
        `diffdrive-mpc simulate --log`, a recording of the node, and a bag with /cmd_vel and /odom or /imu.
    sample_time
        Sample time of the records [s]; None for the sample time of the log.
    diagnosed
        True to compare commands and sensors with each other, which takes most of the time.

    Returns
    -------
    Log
        The usable stretches and all findings. Data are never repaired; findings report omitted data and the ends of
        stretches.

    Raises
    ------
    models.checked_yaml.ConfigError
        If the file or the mapping cannot be read, names are missing, the times come from two clocks, no stretch is long
        enough, or pauses make the sampled log too long. Constant commands, wrong signs and wrong units are findings of
        severity "error".
    """
    path = Path(path)
    if sample_time is not None and not (np.isfinite(sample_time) and sample_time > 0):
        raise ConfigError(f"sample time {sample_time} s; it must be positive and finite")
    if not path.exists():
        raise ConfigError(f"{path}: there is no such file or folder")
    loaded = mapping if mapping is None or isinstance(mapping, LogMapping) else load_mapping(mapping)
    settings = check_settings()
    raw = without_spikes(_read_raw(path, loaded), settings)
    stated = loaded or (LogMapping() if raw.topics else base_mapping(path, None))
    period = usual_step([stretch.clock for stretch in raw.stretches])
    dt = sample_time or raw.sample_time or period
    if not (np.isfinite(dt) and np.isfinite(period)):
        raise ConfigError(f"{path}: no two rows of a stretch have increasing times; check time, segment and command")
    # With a wrong unit of time, all later checks would report consequences of it, so this error ends the reading.
    if finding := check_period(raw.name, period, settings, stated):
        raise_on_error([finding])
    max_step = (loaded.gap if loaded else None) or settings.max_step(period)
    records, findings = _build_records(raw, dt, max_step, loaded.times if loaded else (), settings)
    source = "mapping" if isinstance(mapping, LogMapping) else Path(mapping or "").name
    unused_notes = [
        Finding("unused value", "note", source, message) for message in (loaded.unused_entries() if loaded else ())
    ]
    findings = [*unused_notes, *raw.findings, *check_timing(raw, period, settings), *findings]
    # Stuck readings are removed before headings and streams are computed from them.
    records, stuck = check_sensors(records, settings)
    poses = [part.measured["pose"] for part in raw.stretches if "pose" in part.measured]
    if any(pose.value.shape[1] == len("xy") for pose in poses):
        records, notes = with_headings(raw.name, records)
        findings += notes
    streams = streams_of(records, settings)
    streams.mapping = stated
    findings += [*stuck, *check_commands(raw.name, records, settings)]
    if diagnosed:
        # Resampling hides short zeros, dead zones and rounding, so these checks use the raw log.
        checks = (check_publishers, check_dead_readings, check_resolution)
        findings += [finding for raw_check in checks for finding in raw_check(raw, settings)]
        findings += diagnose(raw.name, streams, settings)
    findings = [_as_stated(finding, stated) if finding.changes else finding for finding in findings]
    return Log(raw.name, tuple(records), tuple(findings), streams, loaded.sources() if loaded else {}, raw.topics)


def _as_stated(finding: Finding, mapping: LogMapping) -> Finding:
    """Return a finding with its changes relative to a mapping, or without them if the mapping has no key for them."""
    changes = stated_changes(mapping, finding.changes)
    message = finding.message if changes else f"{finding.message}; the mapping has no key for this: correct its source"
    return replace(finding, message=message, changes=changes)


def _read_raw(path: Path, mapping: LogMapping | None) -> RawLog:
    """Read a log with the reader for its type."""
    if (mapping is None or mapping.columns is not None) and is_drive_log(path):
        return read_drive(path, mapping)
    return (read_bag if is_bag(path) else read_csv)(path, mapping)


def _build_records(
    raw: RawLog, dt: float, max_step: float, times: Sequence[tuple[float, float]], settings: CheckSettings
) -> tuple[list[Record], list[Finding]]:
    """Build the records of all sufficiently long stretches, with findings about gaps and shorter stretches."""
    records: list[Record] = []
    findings: list[Finding] = []
    max_count, end, remaining = 0, np.inf, settings.max_samples
    for stretch in raw.stretches:
        for first, last in split_at_pauses(stretch, max_step, times):
            if not times and first - end > max_step:
                findings.append(gap_finding(raw.name, end, first, settings))
            end = last
            remaining -= int(min((last - first) / dt + 1, 2 * settings.max_samples))
            if remaining < 0:
                raise ConfigError(
                    f"{raw.name}, {first:.1f} to {last:.1f} s: sampled every {dt:.3g} s, the log has more than "
                    f"{settings.max_samples:,} samples; give a shorter 'gap' in the mapping "
                    f"(now {max_step:.3g} s), other 'times', or a longer sample time"
                )
            record = resample(raw.name, stretch, first, last, dt, settings)
            count = 0 if record is None else len(record.command)
            max_count = max(max_count, count)
            if record is not None and count >= settings.min_samples:
                records.append(record)
            else:
                message = f"{count} samples, fewer than {settings.min_samples}; the stretch is left out"
                place = f"{raw.name}, {first:.1f} to {last:.1f} s"
                findings.append(Finding("short stretch", "note", place, message, (first, last)))
    if not records:
        bursts = [finding.message for finding in raw.findings if finding.kind == "silent commands"]
        hint = f"; {bursts[0]}: set `on_change: true` for this topic" if bursts else ""
        remedy = f"record for longer, or give a longer 'gap' in the mapping (now {max_step:.3g} s){hint}"
        if times and not max_count:
            first, last = raw.stretches[0].clock[0], raw.stretches[-1].clock[-1]
            remedy = f"'times' of the mapping are outside the log, which is from {first:.1f} to {last:.1f} s"
        raise ConfigError(
            f"{raw.name}: {max_count} samples in the longest stretch, at least {settings.min_samples} are needed; "
            f"{remedy}"
        )
    return records, findings
