"""Runs as CSV logs: one row per tick, the columns those of `Run.columns`.

`models.logs` reads them, with the shipped mapping `simulate`.
"""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffdrive_mpc.models.whole_file import whole_file
from diffdrive_mpc.sim.run import Run


def write_log(run: Run, path: str | Path) -> None:
    """Write `run` to a CSV file; a cell is empty where a sensor had no news.

    Numbers are written so that reading gives back the same bits. The file appears complete or not at all.

    Raises
    ------
    models.checked_yaml.ConfigError
        If `path` is something else than a file or cannot be written to.
    """
    with whole_file(path) as draft:
        write_rows(run, draft)


def write_rows(run: Run, path: Path) -> None:
    """Write the header and the rows of `run` straight into `path`."""
    columns = run.columns
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows(zip(*(_cells(column) for column in columns.values()), strict=True))


def _cells(column: NDArray[Any]) -> list[str]:
    if column.dtype == object:
        return list(column)
    return ["" if np.isnan(cell) else repr(cell) for cell in column.tolist()]
