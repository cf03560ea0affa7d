"""MCAP logs of runs in the format of `models.logs.drive_log`, with topics of node and robot, and `Run.columns`."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from diffdrive_mpc.models.errors import checked_call
from diffdrive_mpc.models.logs.drive_log.tick import Cell
from diffdrive_mpc.models.logs.drive_log.topics import path_times
from diffdrive_mpc.models.logs.drive_log.writer import drive_writer
from diffdrive_mpc.models.logs.mcap_file import MCAP_MAGIC
from diffdrive_mpc.models.whole_file import whole_file
from diffdrive_mpc.sim.run import Run
from diffdrive_mpc.sim.sensing.odometry import Odometry

START = 10**9
"""Stamp in the file for time 0 of the run [ns]; it is not zero, since ROS treats zero stamps as unset."""
_NANO = 10**9


@checked_call()
def write_log(run: Run, path: str | Path, metadata: Mapping[str, Mapping[str, str]] | None = None) -> None:
    """Write `run`, including its stored plans, to an MCAP file; the file is written atomically.

    Parameters
    ----------
    run
        Run to write.
    path
        Path of the file.
    metadata
        Additional metadata records by name; each record maps keys to strings.

    Raises
    ------
    models.checked_yaml.ConfigError
        If `path` is not a regular file, not writable, or a file of another kind.
    """
    with whole_file(path, begins=MCAP_MAGIC) as draft:
        write_ticks(run, draft, metadata or {})


def write_ticks(
    run: Run, path: Path, metadata: Mapping[str, Mapping[str, str]], correction: tuple[float, float] = (1.0, 1.0)
) -> None:
    """Write a run directly to `path`; its odometry divides the readings of wheels and gyro by `correction` [-]."""
    period = round(_NANO * run.sample_time)
    labels = {"sample_time_s": repr(run.sample_time), "trajectory": run.reference.name, "ended": run.ended}
    plans = run.plans if run.plans.size else np.full((len(run.time), 0, 3), np.nan)
    with drive_writer(path, {"run": labels, **metadata}) as writer:
        times = path_times(run.reference.duration)
        writer.reference(START, [_stamp(time) for time in times.tolist()], run.reference.sample(times).pose)
        odometry = Odometry(run.true_pose[0], 0, use_pose_sensor=False, correction=correction)
        for row, plan, measurement in zip(_rows(run), plans, run.measurements, strict=True):
            planned = plan if len(plan) and math.isfinite(plan[0, 0]) else None
            pose = odometry.update(float(row["t_s"]), measurement).tolist()
            now = _stamp(row["t_s"])
            writer.tick(now, row, measurement=measurement, plan=planned, period=period, odometry_pose=pose)


def _rows(run: Run) -> Iterator[dict[str, Cell]]:
    """Yield the known values of each tick by column."""
    columns = {name: column.tolist() for name, column in run.columns.items()}
    for cells in zip(*columns.values(), strict=True):
        yield {name: cell for name, cell in zip(columns, cells, strict=True) if not _is_missing(cell)}


def _is_missing(cell: Cell) -> bool:
    return isinstance(cell, float) and math.isnan(cell)


def _stamp(time: Cell) -> int:
    assert isinstance(time, float)
    return START + round(_NANO * time)
