"""Trajectories through timed poses, from a CSV file or from memory, interpolated by cubic splines in time."""

from __future__ import annotations

import csv
from array import array
from io import TextIOWrapper
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicHermiteSpline, CubicSpline

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.input_file import open_input
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.plain_text import plain_line
from diffdrive_mpc.mpc.trajectories.limits import BeyondLimitError, TrajectoryLimits
from diffdrive_mpc.mpc.trajectories.settings import load_settings
from diffdrive_mpc.mpc.trajectories.spline import SplineTrajectory

_MOST = {"t": 1e12, "x": 1e6, "y": 1e6, "theta": 1e6}
"""A thousand kilometres and turns beyond counting are mistakes of units, and squares of more would overflow."""
_COLUMNS = tuple(_MOST)


def read_timed_poses(path: Path, limits: TrajectoryLimits) -> SplineTrajectory:
    """Lay a trajectory through the timed poses of a CSV file; see `lay_timed_poses`.

    The file has a header with the columns t [s], x, y [m] and theta [rad]; others are ignored.

    Raises
    ------
    models.checked_yaml.ConfigError
        If the file cannot be read, has fewer than two rows, a value that is no finite number, a time that does not
        increase, a speed beyond `limits`, or a heading that does not point along the direction of travel.
    """
    return lay_timed_poses(_read(path), limits, name=path.stem, where=str(path))


def lay_timed_poses(
    rows: FloatArray, limits: TrajectoryLimits | None, *, name: str, where: str, rates: FloatArray | None = None
) -> SplineTrajectory:
    """Lay twice continuously differentiable splines through timed poses, or splines with the rates that are given.

    Parameters
    ----------
    rows
        (m, 4), m >= 2, of finite numbers: t [s], which increases and whose first becomes time 0; x, y [m];
        theta [rad], which may be wrapped: it is taken to turn by less than pi from row to row.
    limits
        Speeds to respect, between the rows as well as at them; None: only sideways travel is refused. Accelerations are
        not checked: the rows decide them.
    name
        Name for tables and figures.
    where
        Source of the rows, for error messages.
    rates
        (m, 3) time derivatives of x, y [m/s] and theta [rad/s] at the rows, where they are known.

    Raises
    ------
    models.checked_yaml.ConfigError
        If there are too many rows, a speed is beyond `limits`, or a heading does not point along the direction of
        travel.
    """
    settings = load_settings()
    pieces = settings.pieces_between(len(rows), settings.pieces_per_row, settings.least_pieces_per_row, where)
    nodes, through = rows[:, 0] - rows[0, 0], np.column_stack([rows[:, 1:3], np.unwrap(rows[:, 3])])
    splines = CubicSpline(nodes, through) if rates is None else CubicHermiteSpline(nodes, through, rates)
    share = np.arange(pieces) / pieces
    times = np.append((splines.x[:-1, None] + np.diff(splines.x)[:, None] * share).ravel(), splines.x[-1])
    poses, slopes = splines(times), splines(times, 1)
    _check_speeds(where, times + rows[0, 0], poses, slopes, limits)
    # The Hermite form through nodes of a cubic spline is that spline.
    return SplineTrajectory.through(name, times, poses, slopes)


def _read(path: Path) -> FloatArray:
    """Columns t, x, y, theta of the file, (m, 4), checked for form."""
    settings = load_settings()
    most = settings.most_pieces // settings.least_pieces_per_row
    try:
        with TextIOWrapper(open_input(path), encoding="utf-8-sig", newline="") as file:
            reader = csv.reader(file)
            header = [cell.strip() for cell in next(reader, [])]
            missing = [name for name in _COLUMNS if name not in header]
            if missing:
                raise ConfigError(
                    f"{path}, line 1: column '{missing[0]}' is missing; the header must name {','.join(_COLUMNS)}"
                )
            columns = [header.index(name) for name in _COLUMNS]
            lines, numbers = array("q"), array("d")
            for cells in reader:
                if any(cell.strip() for cell in cells):
                    numbers.extend(_numbers(path, reader.line_num, cells, columns))
                    lines.append(reader.line_num)
                if len(lines) > most:
                    raise ConfigError(
                        f"{path}: more than {most:,} timed poses; leave rows out, the path between them is smooth"
                    )
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise ConfigError(f"{path}: cannot be read ({getattr(error, 'strerror', None) or error})") from error
    if len(lines) < 2:
        raise ConfigError(f"{path}: {len(lines)} timed poses; give at least two rows below the header")
    rows = np.array(numbers).reshape(-1, len(_COLUMNS))
    late = np.flatnonzero(np.diff(rows[:, 0]) <= 0)
    if late.size:
        raise ConfigError(
            f"{path}, line {lines[late[0] + 1]}: t = {rows[late[0] + 1, 0]:g} s does not come after the row before; "
            "sort the rows and drop double ones"
        )
    return rows


def _numbers(path: Path, line: int, cells: list[str], columns: list[int]) -> list[float]:
    """Parse the four numbers of one row."""
    if len(cells) <= max(columns):
        raise ConfigError(f"{path}, line {line}: {len(cells)} values are fewer than the header names; complete the row")
    numbers = []
    for name, column in zip(_COLUMNS, columns, strict=True):
        try:
            number = float(cells[column])
        except ValueError:
            number = np.nan
        if not np.isfinite(number):
            raise ConfigError(
                f"{path}, line {line}: {name} = '{plain_line(cells[column], 40)}' is not a finite number; correct it"
            )
        if abs(number) > _MOST[name]:
            raise ConfigError(
                f"{path}, line {line}: {name} = {number:g} is beyond {_MOST[name]:g}; is it in m, s, rad?"
            )
        numbers.append(number)
    return numbers


def _check_speeds(
    where: str, times: FloatArray, poses: FloatArray, rates: FloatArray, limits: TrajectoryLimits | None
) -> None:
    """Refuse speeds beyond the limits and sideways travel."""
    settings = load_settings()
    cos, sin = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    forward, sideways = rates[:, 0] * cos + rates[:, 1] * sin, rates[:, 1] * cos - rates[:, 0] * sin
    slower = "stretch the time or lower the speed"
    along = "let theta point along the direction of travel, or give more rows"
    for name, unit, speed, bound, excess, remedy in (
        ("v", "m/s", forward, limits.v if limits else np.inf, settings.speed_excess, slower),
        ("omega", "rad/s", rates[:, 2], limits.omega if limits else np.inf, settings.speed_excess, slower),
        ("sideways speed", "m/s", sideways, settings.lateral_speed, 0.0, along),
    ):
        worst = int(np.argmax(np.abs(speed)))
        if abs(speed[worst]) > bound * (1 + excess):
            kind = ConfigError if speed is sideways else BeyondLimitError
            raise kind(
                f"{where}: {name} = {speed[worst]:.3g} {unit} at t = {times[worst]:.3f} s is beyond the limit of "
                f"{bound:.3g} {unit}; {remedy}"
            )
