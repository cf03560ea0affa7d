"""Runs of many cases, with one row per run in pandas tables, and grouping of rows."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, is_dataclass
from functools import partial
from typing import Any

import numpy as np
import pandas as pd
from pandas import DataFrame

from diffdrive_mpc.bench.case import Case
from diffdrive_mpc.bench.controllers import run_case
from diffdrive_mpc.bench.plain_values import plain
from diffdrive_mpc.bench.run_row import CLOCK, Row, driver_names, row_of
from diffdrive_mpc.bench.runner import OnDone, run_tasks
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.sim import Run

Measure = Callable[[Case, Run], Mapping[str, object]]
"""Function that computes further columns from a run, in the process of the run; the run itself is not stored."""
PROCESSOR = "processor_s"
"""Column of the processor time of a run [s]."""
COMPARED = "compared"
"""Column with the name of the controller and all settings that vary among the rows; see
`bench.run_row.driver_names`."""


@dataclass(frozen=True)
class ExperimentRun:
    """Run of an experiment: its case and labels, which become additional columns."""

    case: Case
    labels: Mapping[str, object] = field(default_factory=dict)


def drive_all(
    drives: Sequence[ExperimentRun],
    jobs: int,
    on_done: OnDone,
    measure: Measure | None = None,
    run_one: Callable[[Case], Run] = run_case,
) -> DataFrame:
    """Run `drives` in `jobs` processes, see `bench.runner.run_tasks`; return one row per run, in the order of `drives`.

    Parameters
    ----------
    drives
        Runs of the experiment.
    jobs, on_done
        Arguments of `run_tasks`.
    measure
        Function that computes further columns from a run; None for no further columns.
    run_one
        Function that runs a case.
    """
    return frame(run_tasks([partial(_row, drive, measure, run_one) for drive in drives], jobs, on_done))


def _row(drive: ExperimentRun, measure: Measure | None, run_one: Callable[[Case], Run]) -> Row:
    start = time.process_time()
    run = run_one(drive.case)
    cost = {PROCESSOR: time.process_time() - start}
    return row_of(drive.case, run) | cost | dict(drive.labels) | (dict(measure(drive.case, run)) if measure else {})


def frame(rows: Iterable[Row]) -> DataFrame:
    """Build a table of rows; arrays and cases are stored as objects."""
    return DataFrame(list(rows))


def concatenate(*parts: DataFrame) -> DataFrame:
    """Concatenate tables; omit empty tables and repeated cases."""
    non_empty = [part for part in parts if len(part)]
    return pd.concat(non_empty, ignore_index=True).drop_duplicates("case") if non_empty else DataFrame()


def values(rows: DataFrame, column: str) -> FloatArray:
    """Return the numbers (runs,) of a column; unknown values are NaN."""
    return np.asarray(rows[column].to_numpy(dtype=float)) if len(rows) else np.zeros(0)


def mean(rows: DataFrame, column: str) -> float:
    """Compute the mean of a column over runs; NaN if there are no runs, or if a run lacks the value."""
    column_values = values(rows, column)
    return float(np.mean(column_values)) if column_values.size else math.nan


def total(rows: DataFrame, column: str) -> int:
    """Sum a column of counts or booleans over all runs."""
    return int(values(rows, column).sum())


def group_rows(rows: DataFrame, columns: Sequence[str]) -> list[tuple[tuple[str, ...], DataFrame]]:
    """Group rows by columns in the order of first appearance; the first column varies slowest.

    The column `COMPARED` contains the name of the controller and every setting that varies within a group of the
    preceding columns.
    """
    if not len(rows) or not columns:
        return [((), rows)] if len(rows) else []
    keys: list[pd.Series[Any]] = []
    for column in columns:
        if column == COMPARED:
            texts = rows.groupby(keys, observed=True)["case"].transform(_names) if keys else _names(rows["case"])
        else:
            texts = rows[column].map(str)
        keys.append(texts.astype(pd.CategoricalDtype(texts.unique())))
    return [(tuple(map(str, names)), part) for names, part in rows.groupby(keys, observed=True)]


def _names(cases: pd.Series[Any]) -> pd.Series[Any]:
    return pd.Series(driver_names(list(cases)), cases.index)


def by(rows: DataFrame, column: str) -> dict[str, DataFrame]:
    """Group rows by the value of a column (or of `COMPARED`), in the order of first appearance."""
    return {name: part for (name,), part in group_rows(rows, [column])}


def json_rows(rows: DataFrame, digits: int = 6) -> list[Row]:
    """Convert rows to plain values without timings, runs and arrays; the overrides of the case are under "set"."""
    columns = [name for name in rows if name not in ("case", "run", PROCESSOR) and not str(name).startswith(CLOCK)]
    return [
        plain(
            {
                name: row[name]
                for name in columns
                if not (isinstance(row[name], (np.ndarray, dict)) or is_dataclass(row[name]))
            }
            | {"set": dict(row["case"].overrides)},
            digits,
        )
        for row in rows.to_dict("records")
    ]
