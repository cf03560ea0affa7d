"""The columns of a CSV log as signals in SI units, row by row."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.column_mapping import (
    FOUR_WHEELS,
    SIDES,
    CommandColumns,
    EncoderColumns,
    SignalColumn,
    WheelColumn,
    Wheels,
)
from diffdrive_mpc.models.logs.csv_files.csv_table import CsvTable
from diffdrive_mpc.models.logs.record import BoolArray, Finding, ranges
from diffdrive_mpc.models.logs.signals import Signal, increasing
from diffdrive_mpc.models.logs.units import FACTORS
from diffdrive_mpc.models.wheels import WheelKinematics

Rows = NDArray[np.intp]


@dataclass(frozen=True)
class RowSignal:
    """A signal with a value, or none, in each of the n rows of a table.

    Attributes
    ----------
    time
        (n,) times that the values are valid for [s].
    value
        (n, width) in SI units; NaN where the row has no reading.
    fresh
        (n,) False where the row repeats the reading of the row before.
    counts
        Whether the values are running counts, whose rate is the signal.
    """

    time: FloatArray
    value: FloatArray
    fresh: BoolArray
    counts: bool = False

    def signal(self, rows: Rows) -> Signal:
        """The readings in these rows, which must be in order of time."""
        rows = rows[(self.fresh & np.isfinite(self.time) & np.isfinite(self.value).all(axis=1))[rows]]
        rows = rows[increasing(self.time[rows])]
        time, value = self.time[rows], self.value[rows]
        if self.counts:
            # A difference of counts is the mean speed between them, so it is valid for the middle.
            return Signal(0.5 * (time[1:] + time[:-1]), np.diff(value, axis=0) / np.diff(time)[:, None])
        return Signal(time, value)


class RowReader:
    """Reads columns of one table in SI units and notes the cells that are not finite.

    Parameters
    ----------
    table
        The table.
    wheels
        Lengths of the mapping; None where it gives none.
    """

    def __init__(self, table: CsvTable, wheels: Wheels | None) -> None:
        self.table = table
        self.wheels = wheels
        self.findings: list[Finding] = []

    def column(self, column: SignalColumn) -> tuple[FloatArray, BoolArray]:
        """Values (n,) in SI units, NaN where there is none, and (n,) True where a cell holds NaN or infinity."""
        values, empty = self.table.numbers(column.column)
        bad = np.isnan(values) & ~empty
        if bad.any():
            place = f"{self.table.path.name}, line {ranges(self.table.lines[bad])}"
            words = f"column '{column.column}' is not finite in {bad.sum()} rows; they are left out"
            self.findings.append(Finding("NaN rows", "warning", place, words))
        return column.sign * self._factor(column) * values, bad

    def command(self, command: CommandColumns) -> tuple[FloatArray, FloatArray | None, BoolArray]:
        """Commands (n, 2) v, omega; (n, 2) left, right or None; (n,) True where a command is not finite."""
        names = ("v", "omega") if command.given("v") else SIDES
        values, bad = self._columns(command, names)
        if command.given("v"):
            return values, None, bad
        return self._twist(values, "command"), values, bad

    def encoders(self, encoders: EncoderColumns) -> tuple[dict[str, FloatArray], bool]:
        """Fields of a record that the encoders fill, and whether they are running counts."""
        fields: dict[str, FloatArray] = {}
        if encoders.given(*FOUR_WHEELS):
            fields["wheel_speeds"] = self._columns(encoders, FOUR_WHEELS)[0]
            fields["wheels"] = 0.5 * (fields["wheel_speeds"][:, :2] + fields["wheel_speeds"][:, 2:])
        if encoders.given(*SIDES):
            fields["wheels"] = self._columns(encoders, SIDES)[0]
        if encoders.given("v"):
            fields["twist"] = self._columns(encoders, ("v", "omega"))[0]
        else:
            fields["twist"] = self._twist(fields["wheels"], "encoders")
        units = {column.unit for name in (*SIDES, *FOUR_WHEELS) if (column := getattr(encoders, name)) is not None}
        if "ticks" in units and (len(units) > 1 or encoders.given("v")):
            raise ConfigError(f"{self.table.path}: encoders: give all columns in ticks, or none")
        return fields, "ticks" in units

    def _columns(self, group: CommandColumns | EncoderColumns, names: tuple[str, ...]) -> tuple[FloatArray, BoolArray]:
        columns = [self.column(getattr(group, name)) for name in names]
        return np.column_stack([values for values, _ in columns]), np.any([bad for _, bad in columns], axis=0)

    def _twist(self, sides: FloatArray, whose: str) -> FloatArray:
        wheels = self._lengths(f"turns the wheel speeds of the {whose} into v and omega")
        return WheelKinematics(wheels.radius, wheels.track).twist(np.hstack([sides, sides]))

    def _factor(self, column: SignalColumn) -> float:
        if isinstance(column, WheelColumn) and column.unit in ("ticks", "ticks/s"):
            ticks = self._lengths("says the ticks per turn").ticks_per_turn
            if ticks is None:
                raise ConfigError(f"{self.table.path}: the mapping needs 'wheels.ticks_per_turn' for '{column.column}'")
            return 2.0 * np.pi / ticks
        if isinstance(column, WheelColumn) and column.unit == "m/s":
            return 1.0 / self._lengths(f"turns the rim speed '{column.column}' into a wheel speed").radius
        return FACTORS[column.unit]

    def _lengths(self, purpose: str) -> Wheels:
        if self.wheels is None:
            raise ConfigError(f"{self.table.path}: the mapping needs 'wheels' with radius and track [m]: it {purpose}")
        return self.wheels


def fresh_rows(value: FloatArray) -> BoolArray:
    """(n,) True where a row of held values (n, width) holds a new reading.

    A changed value is new. So is one that stays for as long as hardly any reading does (95th percentile of the distance
    between changes): a robot at rest is read too.
    """
    changed = np.concatenate([[True], (np.diff(value, axis=0) != 0).any(axis=1)])
    rows = np.flatnonzero(changed)
    longest = int(np.percentile(np.diff(rows), 95)) if len(rows) > 1 else 1
    fresh = changed.copy()
    last = 0
    for i in range(1, len(fresh)):
        fresh[i] |= i - last >= longest
        if fresh[i]:
            last = i
    return fresh
