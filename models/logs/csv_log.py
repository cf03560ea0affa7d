"""Reader of CSV logs: columns become signals in SI units, rows are split into stretches of increasing time."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.check_settings import check_settings
from diffdrive_mpc.models.logs.csv_table import CsvTable, read_header, read_table, require_columns
from diffdrive_mpc.models.logs.diagnosis.readings import check_stamps, hold_period, in_degrees, irregular_spacing
from diffdrive_mpc.models.logs.long_logs import reduce_table
from diffdrive_mpc.models.logs.mapping import (
    FACTORS,
    FOUR_WHEELS,
    SIDES,
    Columns,
    CommandColumns,
    EncoderColumns,
    LogMapping,
    MappedWheels,
    SensorColumns,
    SignalColumn,
    TimeColumn,
    WheelColumn,
    draft_command,
    load_mapping,
)
from diffdrive_mpc.models.logs.record import BoolArray, Finding, MappingChange, format_ranges, raise_on_error
from diffdrive_mpc.models.logs.record_checks import require_one_clock
from diffdrive_mpc.models.logs.sampling import (
    MAX_VALUE,
    RawLog,
    RawStretch,
    Signal,
    hold_missing,
    is_increasing,
    repeat,
    unwrap,
)
from diffdrive_mpc.models.wheels import WheelKinematics

Rows = NDArray[np.intp]
SIMULATION_MAPPING = "simulate"
"""Mapping of logs from `diffdrive-mpc simulate --log`, which are recognised by their columns."""


_EMPTY = 1e299
"""Number that represents an empty cell in comparisons of rows."""


@dataclass(frozen=True)
class RowSignal:
    """A signal over the n rows of a table, with missing values.

    Attributes
    ----------
    time
        (n,) times of the values [s].
    value
        (n, width) values in SI units; NaN in rows without a reading.
    fresh
        (n,) False for rows that repeat the reading of the previous row.
    counts
        True if the values are running counts; the signal is their rate.
    """

    time: FloatArray
    value: FloatArray
    fresh: BoolArray
    counts: bool = False

    def is_complete(self, rows: Rows | slice) -> BoolArray:
        """Mark the rows among `rows` that have a time and all values."""
        return np.asarray(np.isfinite(self.time[rows]) & np.isfinite(self.value[rows]).all(axis=1))

    def signal(self, rows: Rows) -> Signal:
        """Return the readings in `rows`, which must be in order of time."""
        rows = rows[self.fresh[rows] & self.is_complete(rows)]
        # Use the last of the readings with equal times.
        rows = rows[np.diff(self.time[rows], append=np.inf) != 0]
        rows = rows[is_increasing(self.time[rows])]
        time, value = self.time[rows], self.value[rows]
        if self.counts:
            # A difference of counts yields the mean speed of the interval, valid at its centre.
            return Signal(0.5 * (time[1:] + time[:-1]), np.diff(value, axis=0) / np.diff(time)[:, None])
        return Signal(time, value)


class RowReader:
    """Reader of the columns of one table in SI units; records findings about cells that are not finite.

    Parameters
    ----------
    table
        The table.
    wheels
        Parameters of the wheels from the mapping; None if the mapping has none.
    time
        (n,) times of the rows [s].
    """

    def __init__(self, table: CsvTable, wheels: MappedWheels | None, time: FloatArray) -> None:
        self.table = table
        self.time = time
        self.wheels = wheels
        self.findings: list[Finding] = []

    def column(self, column: SignalColumn) -> tuple[FloatArray, BoolArray]:
        """Return values (n,) in SI units with NaN for empty cells, and (n,) True for cells with NaN or infinity."""
        values, empty = self.table.numbers(column.column)
        if empty.all():
            raise ConfigError(
                f"{self.table.path}: column '{column.column}' is empty in every row; name the right column, "
                "or leave it out of the mapping"
            )
        # Squares of larger values would overflow.
        values = np.where(np.abs(values) < MAX_VALUE, values, np.nan)
        bad = np.isnan(values) & ~empty
        if bad.all():
            raise ConfigError(
                f"{self.table.path}: column '{column.column}' holds no usable number in any row; name the right "
                "column, or leave it out of the mapping"
            )
        if bad.any():
            place = f"{self.table.path.name}, line {format_ranges(self.table.lines[bad])}"
            limits = f"not finite or beyond {MAX_VALUE:g}"
            message = f"column '{column.column}' is {limits} in {bad.sum()} rows; these rows are left out"
            self.findings.append(Finding("NaN rows", "warning", place, message))
        return column.sign * self._factor(column) * values, bad

    def command(self, command: CommandColumns) -> tuple[FloatArray, FloatArray | None, BoolArray]:
        """Return twist commands (n, 2), wheel commands (n, 2) or None, and a mask (n,) of non-finite commands."""
        names = ("v", "omega") if command.has("v") else SIDES
        values, bad = self._columns(command, names)
        return (values, None, bad) if command.has("v") else (self._twist(values, "command"), values, bad)

    def encoders(self, encoders: EncoderColumns) -> tuple[dict[str, FloatArray], bool]:
        """Return the fields of a record from the encoders, and True if the columns are running counts."""
        fields: dict[str, FloatArray] = {}
        if encoders.has(*FOUR_WHEELS):
            fields["wheel_speeds"] = self._columns(encoders, FOUR_WHEELS)[0]
            fields["wheels"] = 0.5 * (fields["wheel_speeds"][:, :2] + fields["wheel_speeds"][:, 2:])
        if encoders.has(*SIDES):
            fields["wheels"] = self._columns(encoders, SIDES)[0]
        if encoders.has("v"):
            fields["twist"] = self._columns(encoders, ("v", "omega"))[0]
        else:
            fields["twist"] = self._twist(fields["wheels"], "encoders")
        units = {column.unit for name in (*SIDES, *FOUR_WHEELS) if (column := getattr(encoders, name)) is not None}
        if "ticks" in units and (len(units) > 1 or encoders.has("v")):
            raise ConfigError(f"{self.table.path}: encoders: give all columns in ticks, or none")
        return fields, "ticks" in units

    def _columns(self, group: CommandColumns | EncoderColumns, names: tuple[str, ...]) -> tuple[FloatArray, BoolArray]:
        columns = [self.column(getattr(group, name)) for name in names]
        values = np.column_stack([values for values, _ in columns])
        is_held = isinstance(group, CommandColumns)
        return self._align_messages(values, is_held=is_held), np.any([bad for _, bad in columns], axis=0)

    def _align_messages(self, values: FloatArray, *, is_held: bool) -> FloatArray:
        """Hold or interpolate values (n, k) with columns in separate rows, at all rows or at those of the first."""
        is_filled = np.isfinite(values) & np.isfinite(self.time)[:, None]
        if 2 * np.count_nonzero(is_filled.all(axis=1)) >= is_filled.sum(axis=0).min():
            return values
        if is_held:
            return np.where(is_filled.any(axis=1, keepdims=True), hold_missing(values), np.nan)
        # Steps back in time start a new stretch; they are left out here, because interpolation needs an order.
        clock = np.cumsum(np.fmax(np.diff(self.time, prepend=self.time[0]), 0.0))
        aligned = np.full_like(values, np.nan)
        rows = is_filled[:, 0]
        for column, (cells, filled) in enumerate(zip(values.T, is_filled.T, strict=True)):
            aligned[rows, column] = np.interp(clock[rows], clock[filled], cells[filled], left=np.nan, right=np.nan)
        return aligned

    def _twist(self, sides: FloatArray, source: str) -> FloatArray:
        wheels = self._lengths(f"to convert the wheel speeds of the {source} to v and omega")
        return WheelKinematics(*wheels).twist(np.hstack([sides, sides]))

    def _factor(self, column: SignalColumn) -> float:
        if isinstance(column, WheelColumn) and column.unit in ("ticks", "ticks/s"):
            ticks = None if self.wheels is None else self.wheels.ticks_per_turn
            if ticks is None:
                raise ConfigError(f"{self.table.path}: the mapping needs 'wheels.ticks_per_turn' for '{column.column}'")
            return 2.0 * np.pi / ticks
        if isinstance(column, WheelColumn) and column.unit == "m/s":
            return 1.0 / self._lengths(f"to convert the rim speed '{column.column}' to a wheel speed")[0]
        return FACTORS[column.unit]

    def _lengths(self, purpose: str) -> tuple[float, float]:
        """Return radius and track [m]."""
        if self.wheels is None or self.wheels.radius is None:
            raise ConfigError(f"{self.table.path}: the mapping needs 'wheels' with radius and track [m] {purpose}")
        return self.wheels.radius, self.wheels.track


def fresh_rows(value: FloatArray) -> BoolArray:
    """Mark rows (n,) of held values (n, width) that contain a new reading, one per hold period.

    A changed value is a new reading. An unchanged value, at rest or at constant speed, counts as a new reading after
    each period. If the period is unclear, the 95th percentile of the hold times replaces it.
    """
    changed = np.concatenate([[True], (np.diff(value, axis=0) != 0).any(axis=1)])
    rows = np.flatnonzero(changed)
    period = hold_period(value, check_settings())
    if period is None:
        period = int(np.percentile(np.diff(rows), 95)) if len(rows) > 1 else 1
    # Rows since the last change; every whole period holds a further reading of the same value.
    since = np.arange(len(value)) - np.repeat(rows, np.diff([*rows, len(value)]))
    return np.asarray(since % period == 0)


def read_csv(path: Path, mapping: LogMapping | None) -> RawLog:
    """Read a CSV log.

    Parameters
    ----------
    path
        The file.
    mapping
        Mapping of the columns; None for a log of `diffdrive-mpc simulate --log`.

    Raises
    ------
    models.checked_yaml.ConfigError
        If the file or a column is missing, a cell is not a number, no row has a time and a command, the mapping lacks
        an entry that a unit needs, or the times of a sensor and of the rows come from different clocks.
    """
    columns, wheels = (mapping or _own_mapping(path)).columns, mapping.wheels if mapping else None
    if columns is None:
        raise ConfigError(f"{path}: the mapping has no 'columns', which a CSV file needs")
    header = read_header(path)
    columns = columns.without_absent_sensors(header)
    table = read_table(path, columns.column_names())
    require_columns(path, header, columns.column_names())
    return log_of_table(_selected_rows(table, columns), columns, wheels)


def log_of_table(whole: CsvTable, columns: Columns, wheels: MappedWheels | None = None) -> RawLog:
    """Convert the rows of a table to a log; raise ConfigError as `read_csv` does.

    Parameters
    ----------
    whole
        The table.
    columns
        Mapping of the columns.
    wheels
        Parameters of the wheels from the mapping; None if it has none.
    """
    settings, path = check_settings(), whole.path
    table, findings = reduce_table(whole, columns, _clock_rows(whole, columns), settings)
    findings = [*table.findings, *findings]
    del whole
    if columns.time is not None:
        table, copies = _without_copies(table)
        findings += copies
    time = _times(table, columns)
    reader = RowReader(table, wheels, time)
    commands, wheel_commands, is_invalid = reader.command(columns.command)
    all_rows = np.ones(len(time), dtype=bool)
    sent = time - columns.command.delay
    command = RowSignal(sent, commands, all_rows)
    wheel_command = None if wheel_commands is None else RowSignal(sent, wheel_commands, all_rows)
    measured = _measured_signals(reader, columns, time)
    findings += reader.findings
    clock_rows = _clock_rows(table, columns)
    is_timed = np.isfinite(time) & clock_rows
    # The smoothness of any measured signal indicates the true order of the rows.
    reference = next(iter(measured.values())).value[is_timed, -1]
    if columns.time is not None and (finding := check_stamps(path.name, time[is_timed], reference, settings)):
        raise_on_error([finding])
    stretches = []
    readings = np.column_stack([part.is_complete(slice(None)) for part in (command, *measured.values())])
    for rows in _split_stretches(table, columns, time, is_invalid, readings, findings):
        signal, clock = command.signal(rows), time[rows[clock_rows[rows]]]
        if len(signal.time) and len(clock):
            clock = clock[np.diff(clock, append=np.inf) > 0]
            parts = {field: row_signal.signal(rows) for field, row_signal in measured.items()}
            if "pose" in parts:
                parts["pose"] = Signal(parts["pose"].time, unwrap(parts["pose"].value))
            sides = None if wheel_command is None else wheel_command.signal(rows)
            if not clock_rows.all():
                signal, sides = repeat(signal, clock), None if sides is None else repeat(sides, clock)
            stretches.append(RawStretch(clock, signal, parts, sides))
    if not stretches:
        raise ConfigError(f"{path}: no row has both a time and a command; are these the right columns?")
    return RawLog(path.name, tuple(stretches), tuple(findings), columns.sample_time)


def _clock_rows(table: CsvTable, columns: Columns) -> BoolArray:
    """Return the rows (n,) of the stream with the most readings if each row holds one message; else all rows.

    Exports of ROS 2 bags and PlotJuggler have a row for each message, with empty cells for the other topics.
    """
    all_rows = np.ones(len(table.row), dtype=bool)
    if columns.time is None:
        return all_rows
    streams: list[BoolArray] = []
    for group in (columns.command, columns.encoders, columns.gyro, columns.pose):
        names = [part.column for _, part in group or () if isinstance(part, SignalColumn)]
        if names:
            cells = np.array([np.abs(table.cells(name)) < MAX_VALUE for name in names])
            is_complete = np.asarray(cells.all(axis=0))
            streams.append(is_complete if is_complete.any() else cells[0])
    clock = max(streams, key=np.count_nonzero)
    is_merged = any(np.count_nonzero(stream & clock) < 0.5 * np.count_nonzero(stream) for stream in streams)
    return clock if is_merged else all_rows


def _own_mapping(path: Path) -> LogMapping:
    mapping, header = load_mapping(SIMULATION_MAPPING), read_header(path)
    assert mapping.columns is not None
    required = mapping.columns.without_absent_sensors(header).column_names()
    if len(header) == 1:
        raise ConfigError(
            f"{path}: the first line does not have the names of several columns; delete the lines before them, or give "
            "a log"
        )
    missing = sorted(required - set(header))
    if header and missing:
        shown = f"{', '.join(header[:8])}{', ...' if len(header) > 8 else ''}"
        near = f" (a log of simulate also has {', '.join(missing)})" if len(missing) < len(required) - 1 else ""
        remedy = f"Give a mapping file, {draft_command(path)}"
        raise ConfigError(f"{path}: the columns {shown} are unknown without a mapping{near}. {remedy}")
    return mapping


def _selected_rows(table: CsvTable, columns: Columns) -> CsvTable:
    """Select the rows that satisfy `where` of the mapping."""
    keep = np.ones(len(table.row), dtype=bool)
    for name, required in columns.where.items():
        values = required if isinstance(required, tuple) else (required,)
        keep &= np.isin(table.cells(name), [table.cell(value) for value in values])
    if not keep.any():
        raise ConfigError(f"{table.path}: no row satisfies 'where' in the mapping: {columns.where}")
    return table if keep.all() else table.part(keep)


def _without_copies(table: CsvTable) -> tuple[CsvTable, list[Finding]]:
    """Remove rows that are equal to the row before, including its time; return the finding if there are any."""
    is_copy = np.append(
        False, np.all([np.diff(np.nan_to_num(cells, nan=_EMPTY)) == 0 for cells in table.values.values()], axis=0)
    )
    if not is_copy.any():
        return table, []
    place = f"{table.path.name}, line {format_ranges(table.lines[is_copy])}"
    message = f"{is_copy.sum()} rows are copies of the row before, with the same time; they are left out"
    remaining = table.part(~is_copy)
    remaining.row -= np.cumsum(is_copy)[~is_copy]
    return remaining, [Finding("time stands still", "warning", place, message)]


def _times(table: CsvTable, columns: Columns) -> FloatArray:
    """Return the times (n,) of the rows [s]."""
    if columns.time is None:
        assert columns.sample_time is not None
        return np.asarray(columns.sample_time * table.row, dtype=float)
    return _seconds(table, columns.time)


def _seconds(table: CsvTable, time: TimeColumn) -> FloatArray:
    """Return a column of times (n,) [s], with the nanoseconds added."""
    seconds = FACTORS[time.unit] * table.numbers(time.column)[0]
    return seconds if time.nanosec is None else seconds + 1e-9 * table.numbers(time.nanosec)[0]


def _measured_signals(reader: RowReader, columns: Columns, time: FloatArray) -> dict[str, RowSignal]:
    """Return the measured signals, keyed by field of `Record`."""
    signals: dict[str, RowSignal] = {}

    def add(name: str, sensor: SensorColumns, values: dict[str, FloatArray], counts: bool = False) -> None:
        sensor_time = time
        if sensor.time is not None:
            sensor_time = _seconds(reader.table, sensor.time)
            delays = {"the rows": np.zeros(1), f"column '{sensor.time.column}'": time - sensor_time}
            require_one_clock(
                str(reader.table.path), delays, "log both on one clock, or leave its time out of the mapping"
            )
        readings = np.column_stack(list(values.values()))
        fresh = fresh_rows(readings) if sensor.held else np.ones(len(time), dtype=bool)
        if not (sensor.held or counts):
            reader.findings += _held_finding(reader.table, name, readings)
        if name == "pose" and in_degrees(readings[:, 2:]):
            message = "the steps of the pose's heading are those of degrees, not radians"
            remedy = (MappingChange("pose", "theta.unit", "deg"),)
            reader.findings.append(Finding("wrong unit", "error", reader.table.path.name, message, changes=remedy))
            value = values["pose"] * [1.0, 1.0, FACTORS["deg"]]
            values = {"pose": value}
        for field, value in values.items():
            signals[field] = RowSignal(sensor_time - sensor.delay, value, fresh, counts)

    if columns.encoders is not None:
        add("encoders", columns.encoders, *reader.encoders(columns.encoders))
    if columns.gyro is not None:
        add("gyro", columns.gyro, {"yaw_rate": reader.column(columns.gyro.yaw_rate)[0][:, None]})
    if columns.pose is not None:
        axes = (columns.pose.x, columns.pose.y, columns.pose.theta)
        poses = np.column_stack([reader.column(axis)[0] for axis in axes if axis is not None])
        add("pose", columns.pose, {"pose": poses - np.array([0.0, 0.0, columns.pose.heading_offset])[: poses.shape[1]]})
    if columns.battery is not None:
        parts = (columns.battery.voltage, columns.battery.current)
        add("battery", columns.battery, {"battery": np.column_stack([reader.column(part)[0] for part in parts])})
    if columns.motors is not None:
        columns_read = [reader.column(getattr(columns.motors, name))[0] for name in columns.motors.named_columns]
        add("motors", columns.motors, motor_fields(np.column_stack(columns_read)))
    return signals


def motor_fields(currents: FloatArray) -> dict[str, FloatArray]:
    """Return the fields of a record for currents (n, 2) of the sides, or (n, 4) of the motors [A]."""
    if currents.shape[1] == len(SIDES):
        return {"motor_current": currents}
    return {"motor_current": currents[:, :2] + currents[:, 2:], "motor_currents": currents}


def _held_finding(table: CsvTable, sensor: str, readings: FloatArray) -> list[Finding]:
    """Return a finding if each of the readings (n, width) is clearly repeated over several rows."""
    period = hold_period(readings, check_settings())
    spacing = irregular_spacing(readings, check_settings()) if period is None else f"multiples of {period}"
    if period == 1 or spacing is None:
        return []
    message = f"the readings of the {sensor} change only after {spacing} rows: rows repeat the last reading"
    change = MappingChange(sensor, "held", True)
    return [Finding("held readings", "note", table.path.name, message, changes=(change,))]


def _split_stretches(
    table: CsvTable,
    columns: Columns,
    time: FloatArray,
    is_invalid: BoolArray,
    readings: BoolArray,
    findings: list[Finding],
) -> list[Rows]:
    """Split the rows at changes of the segment, steps back in time, omitted rows and commands that are not finite.

    `readings` (n, streams) marks the rows with a reading of each stream.
    """
    where = f"{table.path.name}, line "
    if np.isnan(time).any():
        lines = format_ranges(table.lines[np.isnan(time)])
        findings.append(Finding("NaN rows", "warning", where + lines, "the row has no time and is left out"))
    rows = np.flatnonzero(np.isfinite(time))
    # Messages of several topics may be logged in another order than their stamps.
    if all((np.diff(time[rows[stream[rows]]]) >= 0).all() for stream in readings.T):
        rows = rows[np.argsort(time[rows], kind="stable")]
    steps = np.diff(time[rows])
    repeated = rows[1:][(steps == 0) & (readings[rows[1:]] & readings[rows[:-1]]).any(axis=1)]
    if len(repeated):
        message = f"{len(repeated)} rows have the time of the row before; the last row of each time is used"
        findings.append(Finding("time stands still", "warning", where + format_ranges(table.lines[repeated]), message))
    is_cut = steps < 0
    for row, step in zip(rows[1:][is_cut], steps[is_cut], strict=True):
        message = f"time goes backwards by {-step:.3f} s, to {time[row]:.3f} s; a new stretch starts"
        findings.append(Finding("time backwards", "warning", f"{where}{table.lines[row]}", message))
    if columns.segment is not None:
        segment = hold_missing(table.cells(columns.segment)[rows])
        is_cut |= segment[1:] != segment[:-1]
    # After an omission of rows, a gap in the row numbers that exceeds the stride ends a stretch.
    if table.row[-1] - table.row[0] >= len(table.row):
        steps_of_rows = np.diff(table.row)
        is_after_omission = np.concatenate([[False], steps_of_rows > np.median(steps_of_rows)])
        is_cut |= np.diff(np.cumsum(is_after_omission)[rows]) > 0
    is_cut |= is_invalid[rows[1:]]
    parts = np.split(rows, np.flatnonzero(is_cut) + 1)
    parts = [part[~is_invalid[part]] for part in parts]
    return [part for part in parts if len(part)]
