"""Trajectories from arrays in memory: the checks of what arrives, and the headings where none are given."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.errors import checked_number, described, wrong_type
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.mpc.config.config_file import load_config
from diffdrive_mpc.mpc.config.schema import ControllerConfig
from diffdrive_mpc.mpc.trajectories.limits import TrajectoryLimits
from diffdrive_mpc.mpc.trajectories.settings import load_settings
from diffdrive_mpc.mpc.trajectories.spline import SplineTrajectory
from diffdrive_mpc.mpc.trajectories.timed_poses import lay_timed_poses
from diffdrive_mpc.mpc.trajectories.timing import TIMINGS, Timing
from diffdrive_mpc.mpc.trajectories.waypoints import lay_waypoints

_MOVING_SHARE = 0.01
"""Below this share of the top speed a path has no direction of its own: the robot keeps its heading."""
_MISFIT_SHARE, _MISFIT = 0.6, {"v": 0.05, "omega": 0.1}
"""Twists may differ from the change of the poses by noise; a wrong unit or sign differs by more [-, m/s, rad/s]."""
_ASIDE, _ALONG = 0.3, 0.1
"""Root mean square of the sine between heading and path: of headings in a wrong unit, and of right ones."""


def trajectory_from_arrays(name: str, columns: Mapping[str, ArrayLike | None]) -> SplineTrajectory:
    """Make the trajectory of `Trajectory.from_arrays` from its columns by name."""
    where = f"trajectory '{name}'"
    arrays = _checked(where, columns)
    times, points = arrays["t"] - arrays["t"][0], np.column_stack([arrays["x"], arrays["y"]])
    rates = CubicSpline(times, points)(times, 1)
    v, omega = arrays.get("v"), arrays.get("omega")
    theta = arrays.get("theta")
    chords = np.gradient(points, times, axis=0)
    theta = _headings(where, rates, chords, v) if theta is None else _checked_headings(where, rates, np.unwrap(theta))
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
    return lay_timed_poses(
        rows, None, name=name, where=where, rates=np.column_stack([rates, turning]) if has_twist else None
    )


def trajectory_from_waypoints(
    points: ArrayLike,
    limits: TrajectoryLimits | ControllerConfig | str | Path | None,
    *,
    name: str,
    speed: float | None,
    timing: Timing,
) -> SplineTrajectory:
    """Make the trajectory of `Trajectory.from_waypoints`."""
    where = f"trajectory '{name}'"
    array = _numbers(where, "points", points)
    if array.ndim != 2 or array.shape[1] != 2:
        raise ConfigError(
            f"{where}: points: expected rows x, y of shape (m, 2), got shape {array.shape}; timed poses go into "
            "Trajectory.from_arrays(t, x, y)"
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
    return lay_waypoints(list(map(tuple, array)), limits, name=name, speed=speed, where=where, timing=timing)


def _checked(where: str, columns: Mapping[str, ArrayLike | None]) -> dict[str, FloatArray]:
    """Columns (n,) of one length, whose times increase."""
    optional = ("theta", "v", "omega")
    given = {name: values for name, values in columns.items() if values is not None or name not in optional}
    arrays = {name: _numbers(where, name, values) for name, values in given.items()}
    count = len(arrays["t"]) if arrays["t"].ndim else 0
    for name, array in arrays.items():
        if array.ndim != 1:
            raise ConfigError(f"{where}: {name}: expected one number per time, shape (n,), got shape {array.shape}")
        if len(array) != count:
            raise ConfigError(f"{where}: {name} has {len(array)} values, t has {count}; give one for each time")
    if count < 2:
        raise ConfigError(f"{where}: {count} rows; give at least two")
    times = arrays["t"]
    late = np.flatnonzero(np.diff(times) <= 0)
    if late.size:
        raise ConfigError(
            f"{where}: t[{late[0] + 1}] = {times[late[0] + 1]:g} s does not come after the time before; sort the rows "
            "and drop double ones"
        )
    longest = load_settings().longest_duration
    if times[-1] - times[0] > longest:
        raise ConfigError(
            f"{where}: it lasts {times[-1] - times[0]:.3g} s, the longest is {longest:g} s; are times in s?"
        )
    return arrays


def _numbers(where: str, name: str, values: ArrayLike | None) -> FloatArray:
    try:
        is_date = np.asarray(values).dtype.kind in "mM"
        array = np.asarray(values, dtype=float)
    except (TypeError, ValueError) as error:
        raise ConfigError(f"{where}: {name}: expected numbers, got {described(values)}") from error
    if is_date:
        raise ConfigError(f"{where}: {name}: got dates; give seconds, such as (t - t[0]) / np.timedelta64(1, 's')")
    odd = np.argwhere(~np.isfinite(array))
    if odd.size:
        raise ConfigError(f"{where}: {name}{odd[0].tolist()} is not a finite number; leave the row out")
    return array


def _headings(where: str, rates: FloatArray, chords: FloatArray, v: FloatArray | None) -> FloatArray:
    """(n,) direction of travel [rad, unwrapped], turned round where `v` is negative; kept where the robot stands.

    It is that of `rates` (n, 2) of a spline, but that of `chords` (n, 2) where the spline swings back at a sudden stop.
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
    kept = headings[moving[last_moving]]
    return np.asarray(np.unwrap(kept) - 2 * np.pi * np.round(kept[0] / (2 * np.pi)))


def _checked_headings(where: str, rates: FloatArray, theta: FloatArray) -> FloatArray:
    """`theta` (n,); raises ConfigError where it fits the path in degrees only."""

    def aside(headings: FloatArray) -> float:
        sideways = rates[:, 1] * np.cos(headings) - rates[:, 0] * np.sin(headings)
        return float(np.linalg.norm(sideways)) / max(float(np.linalg.norm(rates)), 1e-9)

    if aside(theta) > _ASIDE and aside(np.radians(theta)) < _ALONG:
        raise ConfigError(f"{where}: theta fits the path in degrees, not in rad; give np.radians(theta)")
    return theta


def _check_fit(where: str, name: str, unit: str, twist: FloatArray, change: FloatArray, times: FloatArray) -> None:
    """Refuse a twist that the poses contradict: another unit, or another sign."""
    gap = np.abs(twist - change)
    size = max(np.linalg.norm(twist), np.linalg.norm(change))
    if np.linalg.norm(gap) > _MISFIT_SHARE * size + _MISFIT[name] * np.sqrt(len(gap)):
        worst = int(np.argmax(gap))
        raise ConfigError(
            f"{where}: {name} = {twist[worst]:.3g} {unit} at t = {times[worst]:.3g} s, but the poses change by "
            f"{change[worst]:.3g} {unit}; check unit and sign, or leave {name} out"
        )
