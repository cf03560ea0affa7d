"""A log from a file: read, cut into stretches, sampled evenly and checked."""

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
    without_spikes,
)
from diffdrive_mpc.models.logs.diagnosis.streams import streams_of
from diffdrive_mpc.models.logs.drive_log.reader import is_drive_log, read_drive
from diffdrive_mpc.models.logs.headings import with_headings
from diffdrive_mpc.models.logs.mapping import LogMapping, load_mapping
from diffdrive_mpc.models.logs.mapping_changes import of_topics
from diffdrive_mpc.models.logs.record import Finding, Log, Record, refuse
from diffdrive_mpc.models.logs.record_checks import check_commands, check_sensors, check_timing, gap_finding
from diffdrive_mpc.models.logs.sampling import RawLog, pieces, resample, usual_step


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
        A CSV file, or a ROS 2 bag: its folder, or one .mcap or .db3 file.
    mapping
        Name of a shipped mapping, the path of a file that maps the columns or topics, or the content of such a file.
        None for a log of `diffdrive-mpc simulate --log` or of a node that recorded, and for a bag with /cmd_vel and
        /odom or /imu.
    sample_time
        Step of the records [s]; None for that of the log.
    diagnosed
        Whether commands and sensors are compared with each other, which takes most of the time.

    Returns
    -------
    Log
        The stretches that can be used, with everything found wrong. Nothing is repaired: omitted data and ends of
        stretches are reported in findings.

    Raises
    ------
    models.checked_yaml.ConfigError
        If the file or the mapping cannot be read, names are missing, the times come from two clocks, no stretch is long
        enough, or pauses make the log too long to be sampled. Commands that excite nothing, wrong signs and wrong units
        are findings of severity "error".
    """
    path = Path(path)
    if sample_time is not None and not (np.isfinite(sample_time) and sample_time > 0):
        raise ConfigError(f"sample time {sample_time} s; it must be positive and finite")
    if not path.exists():
        raise ConfigError(f"{path}: there is no such file or folder")
    loaded = mapping if mapping is None or isinstance(mapping, LogMapping) else load_mapping(mapping)
    settings = check_settings()
    raw = without_spikes(_raw(path, loaded), settings)
    period = usual_step([stretch.clock for stretch in raw.stretches])
    dt = sample_time or raw.sample_time or period
    if not (np.isfinite(dt) and np.isfinite(period)):
        raise ConfigError(f"{path}: no two rows follow each other in time; is the column of times the right one?")
    if odd := check_period(raw.name, period, settings):
        refuse([odd])
    longest_step = (loaded.gap if loaded else None) or settings.longest_step(period)
    records, findings = _records(raw, dt, longest_step, loaded.times if loaded else (), settings)
    stated = "mapping" if isinstance(mapping, LogMapping) else Path(mapping or "").name
    unused = [Finding("unused value", "note", stated, words) for words in (loaded.unused() if loaded else ())]
    findings = [*unused, *raw.findings, *check_timing(raw, period, settings), *findings]
    records, stuck = check_sensors(records, settings)
    poses = [stretch.measured["pose"].value for stretch in raw.stretches if "pose" in stretch.measured]
    if poses and poses[0].shape[1] == len("xy"):
        records, notes = with_headings(raw.name, records)
        findings += notes
    streams = streams_of(records, settings)
    findings += [*stuck, *check_commands(raw.name, records, settings)]
    if diagnosed:
        hidden = [*check_publishers(raw, settings), *check_dead_readings(raw, settings)]
        faults = [*hidden, *diagnose(raw.name, streams, settings)]
        findings += [replace(fault, changes=of_topics(fault.changes)) for fault in faults] if raw.topics else faults
    return Log(raw.name, tuple(records), tuple(findings), streams, loaded.sources() if loaded else {}, raw.topics)


def _raw(path: Path, mapping: LogMapping | None) -> RawLog:
    """Read a log with the reader for its type."""
    if (mapping is None or mapping.columns is not None) and is_drive_log(path):
        return read_drive(path, mapping)
    return (read_bag if is_bag(path) else read_csv)(path, mapping)


def _records(
    raw: RawLog,
    dt: float,
    longest_step: float,
    times: Sequence[tuple[float, float]],
    settings: CheckSettings,
) -> tuple[list[Record], list[Finding]]:
    """Build records of the stretches that are long enough, with findings about gaps and shorter stretches."""
    records: list[Record] = []
    findings: list[Finding] = []
    longest, end, left = 0, np.inf, settings.most_samples
    for stretch in raw.stretches:
        for first, last in pieces(stretch, longest_step, times):
            if not times and first - end > longest_step:
                findings.append(gap_finding(raw.name, end, first, settings))
            end = last
            left -= int(min((last - first) / dt + 1, 2 * settings.most_samples))
            if left < 0:
                raise ConfigError(
                    f"{raw.name}, {first:.1f} to {last:.1f} s: sampled every {dt:.3g} s, the log is more than "
                    f"{settings.most_samples:,} samples; give a shorter 'gap' in the mapping "
                    f"(now {longest_step:.3g} s), other 'times', or a longer sample time"
                )
            record = resample(raw.name, stretch, first, last, dt, settings)
            count = 0 if record is None else len(record.command)
            longest = max(longest, count)
            if record is not None and count >= settings.fewest_samples:
                records.append(record)
            else:
                words = f"{count} samples, fewer than {settings.fewest_samples}; the stretch is left out"
                place = f"{raw.name}, {first:.1f} to {last:.1f} s"
                findings.append(Finding("short stretch", "note", place, words, (first, last)))
    if not records:
        bursts = [finding.words for finding in raw.findings if finding.kind == "silent commands"]
        silent = f"; {bursts[0]}: say `on_change: true` for this topic" if bursts else ""
        raise ConfigError(
            f"{raw.name}: {longest} samples in the longest stretch, at least {settings.fewest_samples} are needed; "
            f"record for longer, or give a longer 'gap' in the mapping (now {longest_step:.3g} s){silent}"
        )
    return records, findings
