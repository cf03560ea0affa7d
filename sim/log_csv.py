"""Runs as CSV logs, one row per tick, units in the column names."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.sim.run import Run
from diffdrive_mpc.sim.whole_file import whole_file

COLUMNS = (
    "t_s",
    "v_ref_m_s",
    "omega_ref_rad_s",
    "v_wheel_m_s",
    "omega_wheel_rad_s",
    "wheel_fl_rad_s",
    "wheel_fr_rad_s",
    "wheel_rl_rad_s",
    "wheel_rr_rad_s",
    "omega_gyro_rad_s",
    "pose_t_s",
    "pose_x_m",
    "pose_y_m",
    "pose_theta_rad",
    "true_x_m",
    "true_y_m",
    "true_theta_rad",
)
"""Columns in their order. `v_ref`, `omega_ref`: the command sent; `pose_t`: the instant that the pose describes."""


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
    table = np.column_stack(
        [
            run.time,
            run.command,
            run.wheel_twist,
            run.wheel_speeds,
            run.gyro,
            run.measured_pose_time,
            run.measured_pose,
            run.true_pose,
        ]
    )
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COLUMNS)
        writer.writerows([["" if np.isnan(cell) else repr(float(cell)) for cell in row] for row in table])


def read_log(path: str | Path) -> dict[str, FloatArray]:
    """Read a log that `write_log` wrote.

    Returns
    -------
    dict
        One (n,) array per column of `COLUMNS`; NaN where the cell is empty.

    Raises
    ------
    ValueError
        If a column is missing, a row has too few or too many cells, or a cell is no number.
    """
    with Path(path).open(encoding="utf-8", newline="") as file:
        rows = csv.reader(file)
        header = next(rows, [])
        missing = [name for name in COLUMNS if name not in header]
        if missing:
            raise ValueError(f"{path}: column '{missing[0]}' is missing; a log has {', '.join(COLUMNS)}")
        cells = list(rows)
    for number, row in enumerate(cells, start=2):
        if len(row) != len(header):
            raise ValueError(f"{path}, line {number}: {len(row)} cells, expected {len(header)}")
    return {name: _column(path, name, [row[header.index(name)] for row in cells]) for name in COLUMNS}


def _column(path: str | Path, name: str, cells: list[str]) -> FloatArray:
    values = np.empty(len(cells))
    for i, cell in enumerate(cells):
        try:
            values[i] = float(cell) if cell else np.nan
        except ValueError:
            raise ValueError(f"{path}, line {i + 2}, column '{name}': '{cell}' is no number") from None
    return values
