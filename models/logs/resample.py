"""From signals with their own times to evenly sampled records."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.checks.settings import CheckSettings
from diffdrive_mpc.models.logs.record import BoolArray, Record
from diffdrive_mpc.models.logs.signals import Signal, Stretch, usual_step


def hold(signal: Signal, grid: FloatArray, tolerance: float) -> FloatArray:
    """Values (K, width) in force at the times `grid` (K,) [s]: zero-order hold, from the past alone.

    A value at most `tolerance` [s] after a grid point belongs to that point. The first value must not be later.
    """
    return signal.value[np.searchsorted(signal.time, grid + tolerance, side="right") - 1]


def sample(signal: Signal, grid: FloatArray, dt: float, tolerance: float, reach: float) -> tuple[FloatArray, BoolArray]:
    """Sample readings at the times `grid` (K,) [s] with step `dt` [s].

    A reading within `tolerance` [s] of a grid point is taken as it stands; elsewhere the value is interpolated
    between two readings no further apart than `reach` [s], and NaN where there are none.

    Returns
    -------
    tuple
        Values (K, width), and (K,) True where a reading falls on the sample, nearer to it than to any other.
    """
    width = signal.value.shape[1]
    values = np.full((len(grid), width), np.nan)
    fresh = np.zeros(len(grid), dtype=bool)
    if not len(signal.time):
        return values, fresh
    right = np.searchsorted(signal.time, grid)
    before, after = np.clip(right - 1, 0, None), np.clip(right, None, len(signal.time) - 1)
    inside = (right > 0) & (right < len(signal.time)) & (signal.time[after] - signal.time[before] <= reach)
    for j in range(width):
        values[inside, j] = np.interp(grid[inside], signal.time, signal.value[:, j])
    nearest = np.where(np.abs(signal.time[after] - grid) <= np.abs(grid - signal.time[before]), after, before)
    distance = np.abs(signal.time[nearest] - grid)
    exact = distance <= tolerance
    values[exact] = signal.value[nearest[exact]]
    # Half a step is nobody's middle: a hair decides such ties the same way along the whole grid.
    cells = np.floor((signal.time - grid[0]) / dt + 0.5 + 1e-6).astype(int)
    fresh[cells[(cells >= 0) & (cells < len(grid))]] = True
    return values, fresh & np.isfinite(values).all(axis=1)


def pieces(stretch: Stretch, longest_step: float) -> Iterator[tuple[float, float]]:
    """From and to [s] of the parts of a stretch between pauses longer than `longest_step` [s]."""
    edges = np.flatnonzero(np.diff(stretch.clock) > longest_step)
    for first, last in zip([0, *(edges + 1)], [*edges, len(stretch.clock) - 1], strict=True):
        yield float(stretch.clock[first]), float(stretch.clock[last])


def resample(
    name: str, stretch: Stretch, first: float, last: float, dt: float, settings: CheckSettings
) -> Record | None:
    """Sample the part of `stretch` from `first` to `last` [s] evenly, `dt` [s] apart; None where nothing is left.

    The record begins with the first command in the part. Commands and readings outside the part are not used, so
    nothing is held or interpolated across its ends. Readings slower or faster than `dt` are not filtered.
    """
    tolerance = settings.grid_tolerance * dt
    command = stretch.command.between(first - tolerance, last + tolerance)
    if not len(command.time):
        return None
    start = max(first, float(command.time[0]))
    count = int(np.floor((last - start) / dt + settings.grid_tolerance)) + 1
    if count < 1:
        return None
    grid = np.asarray(start + dt * np.arange(count))
    sampled: dict[str, Any] = {"command": hold(command, grid, tolerance)}
    if stretch.wheel_commands is not None:
        sampled["wheel_commands"] = hold(stretch.wheel_commands, grid, tolerance)
    for field, signal in stretch.measured.items():
        reach = settings.longest_step(usual_step([signal.time]))
        part = signal.between(first - tolerance, last + tolerance)
        values, fresh = sample(part, grid, dt, tolerance, reach)
        sampled[field] = values[:, 0] if field == "yaw_rate" else values
        sampled[f"fresh_{field}" if field in ("yaw_rate", "pose") else "fresh_twist"] = fresh
    place = f"{name}, {start:.1f} to {grid[-1]:.1f} s"
    return Record(name=place, start=start, dt=dt, **sampled)
