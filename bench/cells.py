"""Tables over groups of runs, as a file states them: what is grouped, and columns such as "mean lateral_max_m mm".

A column is a statistic, the name of a column of `bench.run_row`, and where they are not the usual ones a unit (`mm`,
`mrad`, `ms`, `percent`) and the number of decimal places.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from pandas import DataFrame

from diffdrive_mpc.bench.experiment import by, nested, total, values, with_mean
from diffdrive_mpc.bench.experiment_file import TableFile
from diffdrive_mpc.bench.table import Table, duration, number
from diffdrive_mpc.models.checked_yaml import ConfigError, check, read_yaml
from diffdrive_mpc.models.interface import FloatArray

Cell = Callable[[DataFrame], str]
"""From the rows of a group to a cell."""
Figure = Callable[[DataFrame], float]
"""From the rows of a group to a number."""

UNITS = {"mm": (1e3, 1), "mrad": (1e3, 1), "ms": (1e3, 2), "percent": (100.0, 1)}
"""Factor from the unit of the column, and the usual decimal places."""


def _of_known(statistic: Callable[[FloatArray], Any]) -> Callable[[FloatArray], float]:
    """A statistic of the values that are known; NaN without any."""

    def made(numbers: FloatArray) -> float:
        known = numbers[np.isfinite(numbers)]
        return float(statistic(known)) if known.size else float("nan")

    return made


STATISTICS: dict[str, Callable[[FloatArray], float]] = {
    "mean": lambda values: float(np.mean(values)),
    "max": lambda values: float(np.max(values)),
    "min": lambda values: float(np.min(values)),
    "median": lambda values: float(np.median(values)),
    "p90": lambda values: float(np.percentile(values, 90)),
    "total": lambda values: float(np.sum(values)),
    "mean_known": _of_known(np.mean),
    "max_known": _of_known(np.max),
}
"""NaN where one run could not compute its value; those of the known leave such runs out."""


def figure(text: str, where: str = "figure") -> Figure:
    """The number that "STATISTIC COLUMN" states, in the unit of the column; NaN without runs.

    Raises ConfigError, naming the place `where`, if it is not understood.
    """
    statistic, _, column = text.partition(" ")
    if statistic not in STATISTICS or not column or " " in column:
        raise ConfigError(f"{where}: '{text}' is no statistic of a column; known: {', '.join(STATISTICS)}")
    return lambda rows: STATISTICS[statistic](values(rows, column)) if len(rows) else float("nan")


def cell(text: str, where: str = "column") -> Cell:
    """The cell that `text` states, such as "mean position_rmse_m mm" or "share completed".

    Beside the statistics there are `runs` (how many), `share` (of how many runs a column is true), and `time` or
    `longest` (mean and maximum of a time, infinite for never).

    Raises ConfigError, naming the place `where`, if it is not understood.
    """
    statistic, *words = text.split()
    column = " ".join(words[:1])
    if text == "runs":
        return lambda rows: str(len(rows))
    if statistic == "share" and len(words) == 1:
        return lambda rows: f"{total(rows, column)}/{len(rows)}"
    if statistic in ("time", "longest") and len(words) == 1:
        made = figure(f"{'mean' if statistic == 'time' else 'max'} {column}", where)
        return lambda rows: duration(made(rows))
    unit = [word for word in words[1:2] if word in UNITS]
    places = words[1 + len(unit) :]
    factor, digits = UNITS[unit[0]] if unit else (1.0, 0 if statistic == "total" else 4)
    if len(places) > 1 or not all(word.isdecimal() for word in places):
        raise ConfigError(f"{where}: '{text}': after the column give a unit ({', '.join(UNITS)}) and decimal places")
    value = figure(f"{statistic} {column}", where)
    return lambda rows: number(factor * value(rows), int(places[0]) if places else digits)


class TableSpec(TableFile):
    """A table over groups of runs, as a file states it."""

    def table(self, rows: DataFrame, cells: Mapping[str, Cell] | None = None, note: str = "") -> Table:
        """The table of those of `rows` that it shows.

        `cells` are those that have a name of their own, and `note` follows that of the file.
        """
        for column, value in self.where.items():
            rows = rows[rows[column] == value]
        made = {heading: self._cell(heading, text, cells or {}) for heading, text in self.columns.items()}
        if self.across:
            made = {
                heading.replace("{}", name): _among(made_cell, part)
                for name, part in by(rows, self.across).items()
                for heading, made_cell in made.items()
            }
        return grouped_table(self.title, rows, self.by, made, self.note + note, mean=self.mean)

    def _cell(self, heading: str, text: str, cells: Mapping[str, Cell]) -> Cell:
        return cells[text] if text in cells else cell(text, f"{self.title}, {heading}")


def _among(made: Cell, part: DataFrame) -> Cell:
    """The cell of those rows of a group that are among `part`."""

    def of_part(rows: DataFrame) -> str:
        own = rows[rows.index.isin(part.index)]
        return made(own) if len(own) else "-"

    return of_part


def load_tables(file: Path) -> dict[str, TableSpec]:
    """The tables of a file by name, in order; raises ConfigError when it has a mistake."""
    return {name: check(TableSpec, data, f"{file.name}: {name}") for name, data in read_yaml(file).items()}


def grouped_table(
    title: str,
    rows: DataFrame,
    names: Mapping[str, str],
    columns: Mapping[str, Cell],
    note: str = "",
    *,
    mean: bool = False,
) -> Table:
    """A table with a row for each group.

    Parameters
    ----------
    title, note
        Of the table.
    rows
        One for each run.
    names
        Columns to group by, under the headings of their names; the first varies most slowly.
    columns
        Cells by heading.
    mean
        Whether below each block of the last of `names` there is a row for all of it.
    """
    *outer, last = names.values()
    entries: list[tuple[tuple[str, ...], DataFrame]] = []
    for above, part in nested(rows, *outer):
        innermost = with_mean(part, last) if mean else by(part, last).items()
        entries += [((*above, name), own) for name, own in innermost]
    return Table.of(title, tuple(names), columns, entries, note)
