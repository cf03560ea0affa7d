"""Trajectories through timed poses from a CSV file or from arrays, interpolated by cubic splines in time."""

from __future__ import annotations

import csv
from array import array
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import CubicHermiteSpline, CubicSpline

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.errors import checked_number, describe_type, wrong_type
from diffdrive_mpc.models.input_file import open_input
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.csv_layout import rest_of_line
from diffdrive_mpc.models.table import plain_line
from diffdrive_mpc.models.two_sided import sides_at
from diffdrive_mpc.mpc.config.config_file import load_config
from diffdrive_mpc.mpc.config.schema import ControllerConfig
from diffdrive_mpc.mpc.trajectories.limits import BeyondLimitError, TrajectoryLimits, load_settings
from diffdrive_mpc.mpc.trajectories.spline import SplineTrajectory
from diffdrive_mpc.mpc.trajectories.timing import TIMINGS, Timing
from diffdrive_mpc.mpc.trajectories.waypoints import time_waypoints

_MAX_VALUES = {"t": 1e12, "x": 1e6, "y": 1e6, "theta": 1e6}
"""Maximum absolute values by column; larger values are due to a wrong unit, and their powers could overflow."""
_COLUMN_NAMES = tuple(_MAX_VALUES)


def read_timed_poses(path: Path, limits: TrajectoryLimits) -> SplineTrajectory:
    """Read timed poses from a CSV file and interpolate them by a trajectory, see `fit_timed_poses`.

    The header of the file contains the columns t [s], x, y [m] and theta [rad]; other columns are ignored.

    Raises
    ------
    models.checked_yaml.ConfigError
        If the file cannot be read, has fewer than two rows or a value that is not a finite number, times do not
        increase, a speed exceeds `limits`, or headings differ from the direction of travel.
    """
    rows = _read(path)
    _check_heading_unit(str(path), CubicSpline(rows[:, 0], rows[:, 1:3])(rows[:, 0], 1), rows[:, 3])
    return fit_timed_poses(rows, limits, name=path.stem, where=str(path))


def fit_timed_poses(
    rows: FloatArray, limits: TrajectoryLimits | None, *, name: str, where: str, rates: FloatArray | None = None
) -> SplineTrajectory:
    """Interpolate timed poses by twice continuously differentiable splines, or by splines with given rates.

    Parameters
    ----------
    rows
        (m, 4) finite values, m >= 2: increasing t [s], whose first value becomes time 0; x, y [m]; theta [rad], which
        may be wrapped, since the turn between consecutive rows is assumed to be less than pi.
    limits
        Speed limits, which are checked at and between the rows; None disables this check. Sideways travel is always
        rejected, and accelerations are never checked.
    name
        Name in tables and figures.
    where
        Source of the rows in error messages.
    rates
        (m, 3) time derivatives of x, y [m/s] and theta [rad/s] at the rows; None if unknown.

    Raises
    ------
    models.checked_yaml.ConfigError
        If there are too many rows, a speed exceeds `limits`, or headings differ from the direction of travel.
    """
    settings = load_settings()
    pieces = settings.pieces_between(len(rows), settings.pieces_per_row, settings.min_pieces_per_row, where)
    nodes, values = rows[:, 0] - rows[0, 0], np.column_stack([rows[:, 1:3], np.unwrap(rows[:, 3])])
    # A cubic spline with given rates cannot also have a continuous second derivative.
    splines = CubicSpline(nodes, values) if rates is None else CubicHermiteSpline(nodes, values, rates)
    share = np.arange(pieces) / pieces
    times = np.append((splines.x[:-1, None] + np.diff(splines.x)[:, None] * share).ravel(), splines.x[-1])
    poses, slopes = splines(times), splines(times, 1)
    _check_speeds(where, times + rows[0, 0], poses, slopes, limits)
    # Hermite interpolation of values and slopes of a cubic spline reproduces the spline.
    return SplineTrajectory.through(name, times, poses, slopes)


def _read(path: Path) -> FloatArray:
    """Read the columns t, x, y, theta (m, 4) of the file, and check the format and the order of the times."""
    settings = load_settings()
    max_rows = settings.max_pieces // settings.min_pieces_per_row
    try:
        with open_input(path) as file:
            reader = csv.reader(_lines(path, file))
            header = [cell.strip() for cell in next(reader, [])]
            missing = [name for name in _COLUMN_NAMES if name not in header]
            if missing:
                names = plain_line(",".join(header), 90)
                remedy = f"the header must name {','.join(_COLUMN_NAMES)} with commas (found {names})"
                raise ConfigError(f"{path}, line 1: column '{missing[0]}' is missing; {remedy}")
            columns = [header.index(name) for name in _COLUMN_NAMES]
            lines, numbers = array("q"), array("d")
            for cells in reader:
                if any(map(str.strip, cells)):
                    numbers.extend(_parse_row(path, reader.line_num, cells, columns))
                    lines.append(reader.line_num)
                if len(lines) > max_rows:
                    raise ConfigError(
                        f"{path}: more than {max_rows:,} timed poses; remove rows, since the path is interpolated"
                    )
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise ConfigError(f"{path}: cannot be read ({getattr(error, 'strerror', None) or error})") from error
    if len(lines) < 2:
        raise ConfigError(f"{path}: {len(lines)} timed poses; give at least two rows below the header")
    rows = np.array(numbers).reshape(-1, len(_COLUMN_NAMES))
    unsorted = np.flatnonzero(np.diff(rows[:, 0]) <= 0)
    if unsorted.size:
        raise ConfigError(
            f"{path}, line {lines[unsorted[0] + 1]}: t = {rows[unsorted[0] + 1, 0]:g} s is not after the previous row; "
            "sort the rows and remove duplicates"
        )
    return rows


def _lines(path: Path, file: BinaryIO) -> Iterator[str]:
    """Yield the lines of a file without line ends; the length of a line is limited, to limit the memory."""
    coding = "utf-8-sig"
    while line := rest_of_line(path, file):
        yield from line.decode(coding).removesuffix("\n").removesuffix("\r").split("\r")
        coding = "utf-8"


def _parse_row(path: Path, line: int, cells: list[str], columns: list[int]) -> list[float]:
    """Parse the four numbers of a row."""
    if len(cells) <= max(columns):
        raise ConfigError(f"{path}, line {line}: {len(cells)} values, fewer than in the header; complete the row")
    numbers = []
    for name, column in zip(_COLUMN_NAMES, columns, strict=True):
        try:
            number = float(cells[column])
        except ValueError:
            number = np.nan
        if not abs(number) <= _MAX_VALUES[name]:  # negated so that NaN is rejected
            if np.isfinite(number):
                fault = f"{name} = {number:g} is beyond {_MAX_VALUES[name]:g}; is it in m, s, rad?"
            else:
                fault = f"{name} = '{plain_line(cells[column], 40)}' is not a finite number; correct it"
            raise ConfigError(f"{path}, line {line}: {fault}")
        numbers.append(number)
    return numbers


def _check_speeds(
    where: str, times: FloatArray, poses: FloatArray, rates: FloatArray, limits: TrajectoryLimits | None
) -> None:
    """Raise ConfigError for speeds that exceed the limits, and for sideways travel."""
    settings = load_settings()
    cos, sin = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    forward, sideways = rates[:, 0] * cos + rates[:, 1] * sin, rates[:, 1] * cos - rates[:, 0] * sin
    slower = "stretch the time or lower the speed"
    along = (
        "let theta [rad] point along the direction of travel, or give more rows; for corners or noisy positions use "
        "few points with Trajectory.from_waypoints, or waypoints in YAML"
    )
    is_full_turn = np.abs(poses[:, 2]).max() > 2 * np.pi
    less_turning = f"convert theta to rad if it is in degrees, or {slower}" if is_full_turn else slower
    for name, unit, speed, limit, excess, remedy in (
        ("v", "m/s", forward, limits.v if limits else np.inf, settings.speed_excess, slower),
        ("omega", "rad/s", rates[:, 2], limits.omega if limits else np.inf, settings.speed_excess, less_turning),
        ("sideways speed", "m/s", sideways, settings.lateral_speed, 0.0, along),
    ):
        bounds = sides_at(limit, speed)
        worst = int(np.argmax(np.abs(speed) / bounds))
        bound = bounds[worst]
        if abs(speed[worst]) > bound * (1 + excess):
            kind = ConfigError if speed is sideways else BeyondLimitError
            raise kind(
                f"{where}: {name} = {speed[worst]:.3g} {unit} at t = {times[worst]:.3f} s is beyond the limit of "
                f"{bound:.3g} {unit}; {remedy}"
            )


_MOVING_SHARE = 0.01
"""Share of the maximum speed [-] below which the robot counts as at rest, without a direction of travel."""
_MAX_TWIST_ERROR_SHARE, _TWIST_NOISE = 0.6, {"v": 0.05, "omega": 0.1}
"""Maximum RMS difference between twists and changes of the poses: share of their RMS [-], and noise [m/s, rad/s]."""
_MAX_SINE = 0.1
"""Maximum RMS of the sine between matching headings and velocities [-]."""


def trajectory_from_arrays(name: str, columns: Mapping[str, ArrayLike | None]) -> SplineTrajectory:
    """Create a trajectory from arrays by column name, see `Trajectory.from_arrays`."""
    if not (isinstance(name, str) and name):
        raise wrong_type("name", "a text", name, "give a name such as 'arrays'")
    where = f"trajectory '{name}'"
    arrays = _check_columns(where, columns)
    times, points = arrays["t"] - arrays["t"][0], np.column_stack([arrays["x"], arrays["y"]])
    rates = CubicSpline(times, points)(times, 1)
    v, omega = arrays.get("v"), arrays.get("omega")
    theta = arrays.get("theta")
    chords = np.gradient(points, times, axis=0)
    if theta is None:
        theta = _headings(where, rates, chords, v)
    else:
        _check_heading_unit(where, rates, theta)
        theta = np.unwrap(theta)
    along = np.column_stack([np.cos(theta), np.sin(theta)])
    turning = CubicSpline(times, theta)(times, 1)
    if v is not None:
        _check_fit(where, "v", "m/s", v, (rates * along).sum(axis=1), arrays["t"])
        rates = v[:, None] * along
    if omega is not None:
        _check_fit(where, "omega", "rad/s", omega, turning, arrays["t"])
        turning = omega
    has_twist = v is not None or omega is not None
    rows = np.column_stack([arrays["t"], points, theta])
    twists = np.column_stack([rates, turning]) if has_twist else None
    return fit_timed_poses(rows, None, name=name, where=where, rates=twists)


def trajectory_from_waypoints(
    points: ArrayLike,
    limits: TrajectoryLimits | ControllerConfig | str | Path | None,
    *,
    name: str,
    speed: float | None,
    timing: Timing,
    max_deviation: float,
) -> SplineTrajectory:
    """Create a trajectory through waypoints, see `Trajectory.from_waypoints`."""
    where = f"trajectory '{name}'"
    if not checked_number("max_deviation", max_deviation, "give m, such as 0.05") > 0:
        raise ConfigError(f"{where}: max_deviation = {max_deviation} m; give a positive number")
    array = _parse_array(where, "points", points)
    if array.ndim != 2 or array.shape[1] != 2:
        raise ConfigError(
            f"{where}: points: expected rows x, y of shape (m, 2), got shape {array.shape}; for timed poses "
            "use Trajectory.from_arrays(t, x, y)"
        )
    if timing not in TIMINGS:
        raise ConfigError(f"{where}: timing {timing!r}; give {', '.join(TIMINGS[:-1])} or {TIMINGS[-1]}")
    if speed is not None:
        speed = checked_number("speed", speed, "give m/s, such as 0.5")
    if speed is not None and not (np.isfinite(speed) and speed > 0):
        raise ConfigError(f"{where}: speed = {speed} m/s; give a positive number")
    if isinstance(limits, (str, Path)):
        limits = load_config(limits)
    if isinstance(limits, ControllerConfig):
        limits = TrajectoryLimits.of_controller(limits.limits)
    elif limits is None:
        limits = TrajectoryLimits.of_robot()
        limits = replace(limits, v=max(limits.v, speed or 0.0))
    elif not isinstance(limits, TrajectoryLimits):
        raise wrong_type("limits", "a configuration or TrajectoryLimits", limits, "give load_config('config.yaml')")
    return time_waypoints(
        list(map(tuple, array)), limits, name=name, speed=speed, where=where, timing=timing, max_deviation=max_deviation
    )


def _check_columns(where: str, columns: Mapping[str, ArrayLike | None]) -> dict[str, FloatArray]:
    """Convert the columns to arrays (n,); raise ConfigError if lengths differ or times do not increase."""
    optional = ("theta", "v", "omega")
    present = {name: values for name, values in columns.items() if values is not None or name not in optional}
    arrays = {name: _parse_array(where, name, values) for name, values in present.items()}
    count = len(arrays["t"]) if arrays["t"].ndim else 0
    for name, column in arrays.items():
        if column.ndim != 1:
            raise ConfigError(f"{where}: {name}: expected one number per time, shape (n,), got shape {column.shape}")
        if len(column) != count:
            raise ConfigError(f"{where}: {name} has {len(column)} values, t has {count}; give one for each time")
    if count < 2:
        raise ConfigError(f"{where}: {count} rows; give at least two")
    times = arrays["t"]
    unsorted = np.flatnonzero(np.diff(times) <= 0)
    if unsorted.size:
        raise ConfigError(
            f"{where}: t[{unsorted[0] + 1}] = {times[unsorted[0] + 1]:g} s is not after the previous time; "
            "sort the rows and remove duplicates"
        )
    settings = load_settings()
    if times[-1] - times[0] > settings.max_duration:
        raise ConfigError(
            f"{where}: duration {times[-1] - times[0]:.3g} s, at most {settings.max_duration:g} s; are times in s?"
        )
    fastest = np.max(np.hypot(np.diff(arrays["x"]), np.diff(arrays["y"])) / np.diff(times))
    if fastest > settings.max_speed:
        raise ConfigError(
            f"{where}: the speed is {fastest:.3g} m/s, at most {settings.max_speed:g} m/s; are x, y in m and t in s?"
        )
    return arrays


def _parse_array(where: str, name: str, values: ArrayLike | None) -> FloatArray:
    try:
        kind = np.asarray(values).dtype.kind
        array = np.asarray(values, dtype=None if kind == "c" else float)
    except (TypeError, ValueError) as error:
        raise ConfigError(f"{where}: {name}: expected numbers, got {describe_type(values)}") from error
    if kind == "c":
        raise ConfigError(f"{where}: {name}: expected real numbers, got complex numbers")
    if kind in "mM":
        raise ConfigError(f"{where}: {name}: got dates; give seconds, such as (t - t[0]) / np.timedelta64(1, 's')")
    invalid = np.argwhere(~np.isfinite(array))
    if invalid.size:
        raise ConfigError(f"{where}: {name}{invalid[0].tolist()} is not a finite number; remove the row")
    return array


def _headings(where: str, rates: FloatArray, chords: FloatArray, v: FloatArray | None) -> FloatArray:
    """Compute the headings (n,) [rad, unwrapped] from the direction of travel, reversed if `v` is negative.

    The direction is that of the spline's `rates` (n, 2), or that of the `chords` (n, 2) if the spline moves backwards,
    as it does at a sudden stop. At rest the heading is constant.
    """
    speed = np.hypot(*chords.T)
    moving = np.flatnonzero(speed > _MOVING_SHARE * speed.max())
    if not moving.size:
        raise ConfigError(f"{where}: x and y do not change, so they have no direction; give theta")
    ahead = (rates * chords).sum(axis=1) > 0
    headings = np.arctan2(*np.where(ahead[:, None], rates, chords).T[::-1])
    if v is not None:
        headings = np.where(v < 0, headings + np.pi, headings)
    last_moving = np.maximum(np.searchsorted(moving, np.arange(len(speed)), side="right") - 1, 0)
    # At rest the heading is that of the last moving row, or that of the first moving row before the first motion.
    heading = headings[moving[last_moving]]
    return np.asarray(np.unwrap(heading) - 2 * np.pi * np.round(heading[0] / (2 * np.pi)))


def _check_heading_unit(where: str, rates: FloatArray, theta: FloatArray) -> None:
    """Raise ConfigError if headings (n,) match the velocities (n, 2) only after conversion from degrees.

    Small headings in rad are almost zero after the conversion. Therefore it must match better than headings of zero.
    """

    def sine(headings: FloatArray) -> float:
        sideways = rates[:, 1] * np.cos(headings) - rates[:, 0] * np.sin(headings)
        return float(np.linalg.norm(sideways)) / max(float(np.linalg.norm(rates)), 1e-9)

    converted = sine(np.radians(theta))
    if sine(theta) > _MAX_SINE and converted < min(_MAX_SINE, sine(np.zeros_like(theta))):
        raise ConfigError(f"{where}: theta matches the path in degrees, not in rad; convert it with np.radians(theta)")


def _check_fit(where: str, name: str, unit: str, twist: FloatArray, change: FloatArray, times: FloatArray) -> None:
    """Raise ConfigError if a twist contradicts the poses, which indicates a wrong unit or sign."""
    gap = np.abs(twist - change)
    size = max(np.linalg.norm(twist), np.linalg.norm(change))
    if np.linalg.norm(gap) > _MAX_TWIST_ERROR_SHARE * size + _TWIST_NOISE[name] * np.sqrt(len(gap)):
        worst = int(np.argmax(gap))
        raise ConfigError(
            f"{where}: {name} = {twist[worst]:.3g} {unit} at t = {times[worst]:.3g} s, but the poses change by "
            f"{change[worst]:.3g} {unit}; check unit and sign of {name} and theta, or remove {name}"
        )
