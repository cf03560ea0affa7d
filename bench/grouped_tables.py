"""Tables over groups of runs whose columns are defined by texts such as "mean lateral_max_m mm".

Such a text contains a statistic, the name of a column of `bench.run_row`, and optionally a unit (`mm`, `mrad`, `ms`,
`percent`) and the number of decimal places.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from pandas import DataFrame

from diffdrive_mpc.bench.experiment import by, group_rows, total, values
from diffdrive_mpc.bench.experiment_file import TableFile
from diffdrive_mpc.bench.table import Table, duration, number
from diffdrive_mpc.models.checked_yaml import ConfigError, check, read_yaml
from diffdrive_mpc.models.interface import FloatArray

Cell = Callable[[DataFrame], str]
"""Function that maps the rows of a group to the text of a cell."""
Figure = Callable[[DataFrame], float]
"""Function that maps the rows of a group to a number."""

UNITS = {"mm": (1e3, 1), "mrad": (1e3, 1), "ms": (1e3, 2), "percent": (100.0, 1)}
"""Conversion factor from the unit of the column, and default number of decimal places."""
KNOWN = "_known"
"""Suffix of a statistic that omits runs without a value; without the suffix, such a run makes the statistic NaN."""
STATISTICS: dict[str, Callable[[FloatArray], Any]] = {
    "mean": np.mean,
    "max": np.max,
    "min": np.min,
    "median": np.median,
    "p90": partial(np.percentile, q=90),
    "total": np.sum,
}


def figure(text: str, where: str = "figure") -> Figure:
    """Parse "STATISTIC COLUMN"; the function returns the statistic in the unit of the column, NaN if there are no runs.

    Raise ConfigError, whose message starts with `where`, if the text is invalid.
    """
    name, _, column = text.partition(" ")
    statistic = STATISTICS.get(name.removesuffix(KNOWN))
    if statistic is None or not column or " " in column:
        raise ConfigError(f"{where}: '{text}' is not a statistic of a column; available: {', '.join(STATISTICS)}")

    def value(rows: DataFrame) -> float:
        numbers = values(rows, column)
        numbers = numbers[np.isfinite(numbers)] if name.endswith(KNOWN) else numbers
        return float(statistic(numbers)) if numbers.size else float("nan")

    return value


def cell(text: str, where: str = "column") -> Cell:
    """Parse a cell such as "mean position_rmse_m mm" or "share completed".

    Further statistics are `runs` (number of runs), `share` (share of runs with a true value), and `time` or `longest`
    (mean and maximum of a time that is infinite if the event did not occur).

    Raise ConfigError, whose message starts with `where`, if the text is invalid.
    """
    statistic, *words = text.split()
    column = " ".join(words[:1])
    if text == "runs":
        return lambda rows: str(len(rows))
    if statistic == "share" and len(words) == 1:
        return lambda rows: f"{total(rows, column)}/{len(rows)}"
    if statistic in ("time", "longest") and len(words) == 1:
        time = figure(f"{'mean' if statistic == 'time' else 'max'} {column}", where)
        return lambda rows: duration(time(rows))
    unit = [word for word in words[1:2] if word in UNITS]
    places = words[1 + len(unit) :]
    factor, digits = UNITS[unit[0]] if unit else (1.0, 0 if statistic == "total" else 4)
    if len(places) > 1 or not all(word.isdecimal() for word in places):
        raise ConfigError(f"{where}: '{text}': the column may precede a unit ({', '.join(UNITS)}) and decimal places")
    value = figure(f"{statistic} {column}", where)
    return lambda rows: number(factor * value(rows), int(places[0]) if places else digits)


class TableSpec(TableFile):
    """Definition of a table over groups of runs, read from a file."""

    def table(self, rows: DataFrame, cells: Mapping[str, Cell] | None = None, note: str = "") -> Table:
        """Build the table of the selected rows.

        `cells` are the cells computed by the program, by name; `note` is appended to the note of the file.
        """
        for column, value in self.where.items():
            rows = rows[rows[column] == value]
        known = cells or {}
        columns = {
            heading: known.get(text) or cell(text, f"{self.title}, {heading}") for heading, text in self.columns.items()
        }
        if self.across:
            columns = {
                heading.replace("{}", name): partial(_cell_of_rows, column_cell, part.index)
                for name, part in by(rows, self.across).items()
                for heading, column_cell in columns.items()
            }
        return grouped_table(self.title, rows, self.by, columns, self.note + note, mean=self.mean)


def _cell_of_rows(column_cell: Cell, index: pd.Index, rows: DataFrame) -> str:
    """Return the cell for the rows of a group whose index is in `index`."""
    part = rows[rows.index.isin(index)]
    return column_cell(part) if len(part) else "-"


def load_tables(file: Path) -> dict[str, TableSpec]:
    """Load the tables of a file by name, in order; raise ConfigError if the file is invalid."""
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
    """Build a table with a row for each group.

    Parameters
    ----------
    title, note
        Title of the table and note below it.
    rows
        One row per run.
    names
        Columns by which the rows are grouped, by heading; the first column varies slowest.
    columns
        Cells by heading.
    mean
        If True, each block of the last of `names` is followed by a row for the whole block.
    """
    entries: list[tuple[tuple[str, ...], DataFrame]] = []
    for outer, block in itertools.groupby(group_rows(rows, list(names.values())), key=lambda entry: entry[0][:-1]):
        entries += (block_entries := list(block))
        if mean and len(block_entries) > 1:
            entries.append(((*outer, "mean"), pd.concat(part for _, part in block_entries)))
    return Table.build(title, tuple(names), columns, entries, note)
