"""A CSV file as a log: its rows in stretches in which time runs forward."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.checks.clocks import require_one_clock
from diffdrive_mpc.models.logs.checks.settings import check_settings
from diffdrive_mpc.models.logs.column_mapping import Columns, LogMapping, SensorColumns, load_mapping
from diffdrive_mpc.models.logs.csv_files.csv_signals import RowReader, Rows, RowSignal, fresh_rows
from diffdrive_mpc.models.logs.csv_files.csv_table import CsvTable, read_table
from diffdrive_mpc.models.logs.record import BoolArray, Finding, ranges
from diffdrive_mpc.models.logs.signals import RawLog, Signal, Stretch, unwrapped
from diffdrive_mpc.models.logs.units import FACTORS

OWN_FORMAT = "simulate"
"""The mapping of the logs that `diffdrive-mpc simulate --log` writes; they are recognised by their columns."""


def read_csv(path: Path, mapping: LogMapping | None) -> RawLog:
    """Read a CSV log.

    Parameters
    ----------
    path
        The file.
    mapping
        Which column is what; None for a log of `diffdrive-mpc simulate --log`.

    Raises
    ------
    models.checked_yaml.ConfigError
        If the file or a column is missing, a cell is no number, no row has a time and a command, the mapping lacks
        something that a unit needs, or a sensor's times are on another clock than the rows'.
    """
    table = read_table(path)
    columns, wheels = (mapping or _own_mapping(table)).columns, mapping.wheels if mapping else None
    if columns is None:
        raise ConfigError(f"{path}: the mapping has no 'columns', which a CSV file needs")
    reader = RowReader(table, wheels)
    findings = list(table.findings)
    time = _times(table, columns)
    commands, wheel_commands, broken = reader.command(columns.command)
    always = np.ones(len(time), dtype=bool)
    command = RowSignal(time, commands, always)
    wheel_command = None if wheel_commands is None else RowSignal(time, wheel_commands, always)
    measured = _measured(reader, columns, time)
    findings += reader.findings
    stretches = []
    for rows in _forward(table, columns, time, broken, findings):
        signal = command.signal(rows)
        if len(signal.time):
            parts = {field: row_signal.signal(rows) for field, row_signal in measured.items()}
            if "pose" in parts:
                parts["pose"] = Signal(parts["pose"].time, unwrapped(parts["pose"].value))
            sides = None if wheel_command is None else wheel_command.signal(rows)
            stretches.append(Stretch(time[rows], signal, parts, sides))
    if not stretches:
        raise ConfigError(f"{path}: no row has both a time and a command; are these the right columns?")
    return RawLog(path.name, tuple(stretches), tuple(findings), columns.sample_time)


def _own_mapping(table: CsvTable) -> LogMapping:
    mapping = load_mapping(OWN_FORMAT)
    assert mapping.columns is not None
    if not mapping.columns.names() <= set(table.header):
        raise ConfigError(
            f"{table.path}: which column is what? Give a mapping file; the columns are {', '.join(table.header)}"
        )
    return mapping


def _times(table: CsvTable, columns: Columns) -> FloatArray:
    """(n,) times of the rows [s]."""
    if columns.time is None:
        assert columns.sample_time is not None
        return columns.sample_time * np.arange(len(table.rows), dtype=float)
    return FACTORS[columns.time.unit] * table.numbers(columns.time.column)[0]


def _measured(reader: RowReader, columns: Columns, time: FloatArray) -> dict[str, RowSignal]:
    """The measured signals by the field of `Record` that they fill."""
    signals: dict[str, RowSignal] = {}

    def add(name: str, sensor: SensorColumns, values: dict[str, FloatArray], counts: bool = False) -> None:
        own = time
        if sensor.time is not None:
            own = FACTORS[sensor.time.unit] * reader.table.numbers(sensor.time.column)[0]
            late = {"the rows": np.zeros(1), f"column '{sensor.time.column}'": time - own}
            require_one_clock(
                str(reader.table.path), late, "log both on one clock, or leave its time out of the mapping"
            )
        together = np.column_stack(list(values.values()))
        fresh = fresh_rows(together) if sensor.held else np.ones(len(time), dtype=bool)
        if not (sensor.held or counts):
            reader.findings += _seems_held(reader.table, name, together)
        for field, value in values.items():
            signals[field] = RowSignal(own - sensor.delay, value, fresh, counts)

    if columns.encoders is not None:
        add("encoders", columns.encoders, *reader.encoders(columns.encoders))
    if columns.gyro is not None:
        add("gyro", columns.gyro, {"yaw_rate": reader.column(columns.gyro.yaw_rate)[0][:, None]})
    if columns.pose is not None:
        axes = (columns.pose.x, columns.pose.y, columns.pose.theta)
        add("pose", columns.pose, {"pose": np.column_stack([reader.column(axis)[0] for axis in axes])})
    return signals


def _seems_held(table: CsvTable, sensor: str, readings: FloatArray) -> list[Finding]:
    """A finding where many readings (n, width) of a moving robot repeat the one before bit for bit."""
    moving = readings[np.isfinite(readings).all(axis=1) & readings.any(axis=1)]
    share = float(np.mean((np.diff(moving, axis=0) == 0).all(axis=1))) if len(moving) > 1 else 0.0
    if share <= check_settings().held_share:
        return []
    words = (
        f"{100 * share:.0f} % of the readings of the {sensor} repeat the one before; if they are held from row to row, "
        "say `held: true` in the mapping"
    )
    return [Finding("held readings", "note", table.path.name, words)]


def _forward(
    table: CsvTable, columns: Columns, time: FloatArray, broken: BoolArray, findings: list[Finding]
) -> list[Rows]:
    """The rows in parts of one segment each, in which time runs forward and every command is known."""
    where = f"{table.path.name}, line "
    if np.isnan(time).any():
        lines = ranges(table.lines[np.isnan(time)])
        findings.append(Finding("NaN rows", "warning", where + lines, "the row has no time; it is left out"))
    rows = np.flatnonzero(np.isfinite(time))
    steps = np.diff(time[rows])
    again = rows[1:][steps == 0]
    if len(again):
        words = f"{len(again)} rows have the time of the row before; the last of each counts"
        findings.append(Finding("time stands still", "warning", where + ranges(table.lines[again]), words))
    cut = steps < 0
    for row, step in zip(rows[1:][cut], steps[cut], strict=True):
        words = f"time goes backwards by {-step:.3f} s, to {time[row]:.3f} s; a new stretch begins"
        findings.append(Finding("time backwards", "warning", f"{where}{table.lines[row]}", words))
    if columns.segment is not None:
        segment = np.array(table.texts(columns.segment))[rows]
        cut |= segment[1:] != segment[:-1]
    cut |= broken[rows[1:]]
    parts = np.split(rows, np.flatnonzero(cut) + 1)
    parts = [part[~broken[part]] for part in parts]
    return [part[np.append(np.diff(time[part]) > 0, True)] for part in parts if len(part)]
