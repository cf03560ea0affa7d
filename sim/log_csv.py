"""Runs as CSV logs: one row per tick, the columns those of `Run.columns`.

`models.logs` reads them, with the shipped mapping `simulate`.
"""

from __future__ import annotations

import csv
import io
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.file_limits import file_limits
from diffdrive_mpc.models.input_file import read_input
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.whole_file import whole_file
from diffdrive_mpc.sim.run import Run

TEXTS = ("mode", "solver_status", "solver_path", "message")
"""Columns that hold words; the others hold numbers."""


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


def read_rows(path: Path) -> tuple[dict[str, FloatArray], dict[str, list[str]], list[str]]:
    """Read a log as it stands.

    Returns
    -------
    tuple
        Numbers by column, NaN in empty cells; texts by column; and what was left out, a line each.

    Raises
    ------
    models.checked_yaml.ConfigError
        If it is no CSV, a row before the last has too few or too many cells, a cell is no number, or no row has a time.
    """
    findings: list[str] = []
    try:
        text = read_input(path, file_limits().run_bytes).decode("utf-8-sig")
        reader = csv.reader(io.StringIO(text, newline=""))
        header, rows, cut = next(reader, []), list[list[str]](), False
        for row in reader:
            if rows and len(rows[-1]) != len(header):
                break
            rows.append(row)
        else:  # only the last row may be cut off
            cut = bool(rows) and len(rows[-1]) < len(header)
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise ConfigError(f"{path}: cannot be read as CSV ({getattr(error, 'strerror', None) or error})") from error
    if rows and len(rows[-1]) != len(header) and not cut:
        raise ConfigError(f"{path}, line {len(rows) + 1}: {len(rows[-1])} cells, the header names {len(header)}")
    if cut:
        rows.pop()
        findings.append(f"{path.name}: the last line is cut off; it is left out")
    if not rows:
        raise ConfigError(f"{path}: the log holds no row; record for longer")
    columns = dict(zip(header, zip(*rows, strict=True), strict=True))
    texts = {name: list(columns.pop(name, ("",) * len(rows))) for name in TEXTS}
    numbers = {name: _column(path, name, cells) for name, cells in columns.items()}
    known = np.isfinite(numbers["t_s"])
    if not known.all():
        lines = ", ".join(str(line) for line in np.flatnonzero(~known)[:5] + 2)
        findings.append(f"{path.name}, line {lines}: the row has no time; it is left out")
        numbers = {name: column[known] for name, column in numbers.items()}
        texts = {name: [text for text, keep in zip(cells, known, strict=True) if keep] for name, cells in texts.items()}
    if not len(numbers["t_s"]):
        raise ConfigError(f"{path}: no row has a time")
    return numbers, texts, findings


def _column(path: Path, name: str, cells: tuple[str, ...]) -> FloatArray:
    try:
        return np.array([cell or "nan" for cell in cells], dtype=float)
    except ValueError as error:
        raise ConfigError(f"{path}, column '{name}': {error}; leave a cell empty where a reading is missing") from error
