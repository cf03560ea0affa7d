"""Resampling of signals with different times to evenly sampled records."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.check_settings import CheckSettings
from diffdrive_mpc.models.logs.record import BoolArray, Finding, Record, Topics

MAX_VALUE = 1e20
"""Maximum plausible reading in any unit, including tick counts; squares of much larger values would overflow."""


@dataclass(frozen=True)
class Signal:
    """Signal of n readings of one sensor, or n commands, in SI units.

    Attributes
    ----------
    time
        (n,) strictly increasing times of the values [s].
    value
        (n, width) finite values.
    """

    time: FloatArray
    value: FloatArray

    def later(self, shift: float) -> Signal:
        """Return the signal delayed by `shift` [s]."""
        return Signal(self.time + shift, self.value)

    def between(self, first: float, last: float) -> Signal:
        """Return the readings from time `first` to time `last` [s], inclusive."""
        inside = (self.time >= first) & (self.time <= last)
        return Signal(self.time[inside], self.value[inside])


@dataclass(frozen=True)
class RawStretch:
    """A part of a log with increasing times.

    Attributes
    ----------
    clock
        (n,) times of the rows or commands of the log [s].
    command
        v [m/s], omega [rad/s]; each command holds until the next.
    measured
        Signals, keyed by field of `Record`.
    wheel_commands
        Left, right [rad/s]; None if the log does not command wheels.
    """

    clock: FloatArray
    command: Signal
    measured: Mapping[str, Signal]
    wheel_commands: Signal | None = None

    def between(self, first: float, last: float) -> RawStretch:
        """Return the part from time `first` to time `last` [s], inclusive."""
        return RawStretch(
            self.clock[(self.clock >= first) & (self.clock <= last)],
            self.command.between(first, last),
            {name: signal.between(first, last) for name, signal in self.measured.items()},
            None if self.wheel_commands is None else self.wheel_commands.between(first, last),
        )


@dataclass(frozen=True)
class RawLog:
    """Output of the reader of a log, before resampling.

    Attributes
    ----------
    name
        Name of the file or bag, for messages.
    stretches
        Stretches in the order of the log.
    findings
        Findings of the reader.
    sample_time
        Sample time of the log [s]; None to determine it from the times.
    topics
        Topics of a bag with their message types.
    """

    name: str
    stretches: tuple[RawStretch, ...]
    findings: tuple[Finding, ...]
    sample_time: float | None = None
    topics: Topics = field(default_factory=dict)


def unwrap(pose: FloatArray) -> FloatArray:
    """Unwrap the third column [rad] of poses (n, 3), or (n, 2) without headings."""
    return np.column_stack([pose[:, :2], np.unwrap(pose[:, 2:], axis=0)])


def is_increasing(time: FloatArray) -> BoolArray:
    """Mark times (n,) that are later than all times before them."""
    before = np.concatenate([[-np.inf], np.maximum.accumulate(time)[:-1]])
    return np.asarray(time > before)


def hold_missing(values: FloatArray) -> FloatArray:
    """Replace missing values (n, ...) by the last value before them."""
    rows = np.arange(len(values)).reshape(-1, *(1,) * (values.ndim - 1))
    last = np.maximum.accumulate(np.where(np.isfinite(values), rows, 0), axis=0)
    return np.take_along_axis(values, last, axis=0)


def repeat(signal: Signal, times: FloatArray) -> Signal:
    """Return a signal that also repeats its last value at each of the `times` [s] after its start."""
    stamps = np.union1d(signal.time, times[times >= signal.time[0]])
    return Signal(stamps, signal.value[np.searchsorted(signal.time, stamps, side="right") - 1])


def usual_step(times: list[FloatArray]) -> float:
    """Compute the usual step of arrays of times [s]; NaN if no array has two times.

    The result is the median, or the mean if rounded or irregular stamps make them differ. A gap of up to two missing
    rows counts as several steps; longer gaps are ignored.
    """
    steps = np.concatenate([np.diff(time) for time in times]) if times else np.empty(0)
    if not len(steps):
        return float("nan")
    median = float(np.percentile(steps, 50, method="lower"))
    rows = np.rint(steps / median)
    near = rows <= 3
    mean = float(steps[near].sum() / rows[near].sum())
    # Six digits suffice for a sample time; further digits are rounding errors of the stamps.
    return float(f"{median if np.isclose(median, mean, rtol=1e-4) else mean:.6g}")


def hold(signal: Signal, grid: FloatArray, dt: float, tolerance: float) -> FloatArray:
    """Resample values (K, width) by a zero-order hold over samples of `dt` [s] that start at `grid` (K,) [s].

    If a value changes within a sample, the result is the time average over the sample. A value within `tolerance` [s]
    of a grid point is assigned to that point. The first value must not be later than the first grid point.
    """
    # Use changes only, so that the result is bit-identical for logs with and without repeated values.
    changes = np.concatenate([[True], (np.diff(signal.value, axis=0) != 0).any(axis=1)])
    value, place = signal.value[changes], (signal.time[changes] - grid[0]) / dt
    place = np.where(np.abs(place - np.rint(place)) <= tolerance / dt, np.rint(place), place)
    starts = np.arange(len(grid), dtype=float)
    first, last = (
        np.searchsorted(place, starts, side="right") - 1,
        np.searchsorted(place, starts + 1.0, side="left") - 1,
    )
    # Integral of the held value up to each change; its differences are the means over the samples.
    integral = np.vstack([np.zeros(value.shape[1]), np.cumsum(np.diff(place)[:, None] * value[:-1], axis=0)])
    held = integral[last] - integral[first] + (starts + 1.0 - place[last])[:, None] * value[last]
    held -= (starts - place[first])[:, None] * value[first]
    return np.asarray(np.where((first == last)[:, None], value[first], held))


def sample(
    signal: Signal, grid: FloatArray, dt: float, tolerance: float, max_gap: float
) -> tuple[FloatArray, BoolArray]:
    """Sample readings at the times `grid` (K,) [s] with step `dt` [s].

    A reading within `tolerance` [s] of a grid point is used unchanged. Other values are interpolated between two
    readings that are at most `max_gap` [s] apart; they are NaN if there are no such readings.

    Returns
    -------
    tuple
        Values (K, width), and (K,) True for the sample nearest to each reading.
    """
    width = signal.value.shape[1]
    values = np.full((len(grid), width), np.nan)
    fresh = np.zeros(len(grid), dtype=bool)
    if not len(signal.time):
        return values, fresh
    right = np.searchsorted(signal.time, grid)
    before, after = np.clip(right - 1, 0, None), np.clip(right, None, len(signal.time) - 1)
    inside = (right > 0) & (right < len(signal.time)) & (signal.time[after] - signal.time[before] <= max_gap)
    for j in range(width):
        values[inside, j] = np.interp(grid[inside], signal.time, signal.value[:, j])
    nearest = np.where(np.abs(signal.time[after] - grid) <= np.abs(grid - signal.time[before]), after, before)
    distance = np.abs(signal.time[nearest] - grid)
    exact = distance <= tolerance
    values[exact] = signal.value[nearest[exact]]
    # Break ties at half a step consistently along the whole grid.
    cells = np.floor((signal.time - grid[0]) / dt + 0.5 + 1e-6).astype(int)
    fresh[cells[(cells >= 0) & (cells < len(grid))]] = True
    return values, fresh & np.isfinite(values).all(axis=1)


def split_at_pauses(
    stretch: RawStretch, max_step: float, times: Sequence[tuple[float, float]] = ()
) -> Iterator[tuple[float, float]]:
    """Yield start and end [s] of the parts of a stretch between long pauses, within the intervals `times` [s]."""
    for start, end in times or [(-np.inf, np.inf)]:
        clock = stretch.clock[(stretch.clock >= start) & (stretch.clock <= end)]
        if not len(clock):
            continue
        edges = np.flatnonzero(np.diff(clock) > max_step)
        for first, last in zip([0, *(edges + 1)], [*edges, len(clock) - 1], strict=True):
            yield float(clock[first]), float(clock[last])


def resample(
    name: str, stretch: RawStretch, first: float, last: float, dt: float, settings: CheckSettings
) -> Record | None:
    """Sample the part of `stretch` from `first` to `last` [s] with step `dt` [s]; return None if it has no sample.

    The record starts with the first command in the part. Commands and readings outside the part are not used, so no
    value is held or interpolated across its ends. Readings slower or faster than `dt` are not filtered.
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
    sampled: dict[str, Any] = {"command": hold(command, grid, dt, tolerance)}
    if stretch.wheel_commands is not None:
        sampled["wheel_commands"] = hold(stretch.wheel_commands, grid, dt, tolerance)
    for key, signal in stretch.measured.items():
        max_gap = settings.max_step(usual_step([signal.time]))
        part = signal.between(first - tolerance, last + tolerance)
        values, fresh = sample(part, grid, dt, tolerance, max_gap)
        if key == "pose" and values.shape[1] == len("xy"):
            values = np.column_stack([values, np.zeros(len(values))])  # `with_headings` fills it
        sampled[key] = values[:, 0] if key == "yaw_rate" else values
        if key not in ("battery", "motor_current", "motor_currents"):
            sampled[f"fresh_{key}" if key in ("yaw_rate", "pose") else "fresh_twist"] = fresh
    place = f"{name}, {start:.1f} to {grid[-1]:.1f} s"
    return Record(name=place, start=start, dt=dt, **sampled)
