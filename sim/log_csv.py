"""CSV logs of runs with one row per tick and the columns of `Run.columns`.

`models.logs` reads these logs with the built-in mapping `simulate`.
"""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffdrive_mpc.models.errors import checked_call
from diffdrive_mpc.models.whole_file import whole_file
from diffdrive_mpc.sim.run import Run

FIRST_COLUMNS = b"t_s,v_ref_m_s,omega_ref_rad_s,"
"""First bytes of the file."""


@checked_call()
def write_log(run: Run, path: str | Path) -> None:
    """Write `run` to a CSV file; cells without a new reading are empty.

    Numbers are written with full precision. The file is written atomically.

    Raises
    ------
    models.checked_yaml.ConfigError
        If `path` is not a regular file, not writable, or a file of another kind.
    """
    with whole_file(path, begins=FIRST_COLUMNS) as draft:
        write_rows(run, draft)


def write_rows(run: Run, path: Path) -> None:
    """Write the header and the rows of `run` directly to `path`."""
    columns = run.columns
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows(zip(*(_cells(column) for column in columns.values()), strict=True))


def _cells(column: NDArray[Any]) -> list[str]:
    if column.dtype == object:
        return list(column)
    return ["" if np.isnan(cell) else repr(cell) for cell in column.tolist()]
