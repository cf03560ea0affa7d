"""Detection of faulty readings and stamps: spikes, held values, dead zones, shuffled and bursty stamps."""

from __future__ import annotations

from dataclasses import replace
from typing import get_args

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.check_settings import CheckSettings
from diffdrive_mpc.models.logs.mapping import FACTORS, LogMapping, TimeUnit
from diffdrive_mpc.models.logs.record import BoolArray, Finding, MappingChange
from diffdrive_mpc.models.logs.sampling import RawLog, RawStretch, Signal

_SENSOR = {"twist": "encoders", "wheels": "encoders", "wheel_speeds": "encoders", "yaw_rate": "gyro", "pose": "pose"}
_MIN_READINGS = 100
"""Minimum number of readings for checks of spikes and held values."""
_FINE_STEPS = 5
"""Minimum ratio of the median to the 5th percentile of the changes of a reading with a fine resolution."""


def without_spikes(raw: RawLog, settings: CheckSettings) -> RawLog:
    """Remove isolated outliers, with a finding per sensor."""
    findings = []
    stretches = list(raw.stretches)
    for sensor in ("encoders", "gyro", "pose"):
        fields = [name for name in raw.stretches[0].measured if _SENSOR.get(name) == sensor]
        if not fields:
            continue
        masks = [_spikes([stretch.measured[name].value for stretch in stretches], settings) for name in fields]
        # Match outliers by time, because single readings may be missing in some signals of a sensor.
        spike_times = [
            np.unique(
                np.concatenate([stretch.measured[name].time[part] for name, part in zip(fields, parts, strict=True)])
            )
            for stretch, *parts in zip(stretches, *masks, strict=True)
        ]
        count = sum(len(times) for times in spike_times)
        total = sum(max(len(stretch.measured[name].time) for name in fields) for stretch in stretches)
        if not count or count > settings.max_spike_share * total:
            continue
        first = next(times[0] for times in spike_times if len(times))
        message = (
            f"{count} readings of the {sensor} ({100 * count / total:.2g} %) are spikes, far from the readings before "
            "and after them; they are left out"
        )
        findings.append(Finding("spikes", "warning", f"{raw.name}, first at {first:.1f} s", message))
        stretches = [_without(stretch, fields, part) for stretch, part in zip(stretches, spike_times, strict=True)]
    return replace(raw, stretches=tuple(stretches), findings=(*raw.findings, *findings))


def _spikes(values: list[FloatArray], settings: CheckSettings) -> list[BoolArray]:
    """Mark isolated readings (n,) of each stretch, at most two in a row, that deviate strongly from both neighbours."""
    deviations = [_deviations(part) for part in values]
    all_deviations, readings = np.concatenate(deviations), np.concatenate(values)
    if len(all_deviations) < _MIN_READINGS:
        return [np.zeros(len(part), dtype=bool) for part in values]
    typical = np.percentile(all_deviations, 95, axis=0)
    span = np.ptp(np.percentile(readings, [5, 95], axis=0), axis=0)
    bound = np.maximum(settings.spike_scatter * typical, settings.spike_span * span)
    return [((part > bound) & (bound > 0)).any(axis=1) for part in deviations]


def _deviations(values: FloatArray) -> FloatArray:
    """Compute the deviations (n, width) of readings from their neighbours; 0 for values between the neighbours."""
    deviation = np.zeros_like(values)
    if not len(values):
        return deviation  # a stretch without readings of the sensor
    padded = np.pad(values, ((2, 2), (0, 0)), mode="edge")
    count = len(values)
    for before, after in ((1, 1), (1, 2), (2, 1)):
        left, right = (values - padded[2 + k : 2 + k + count] for k in (-before, after))
        both_sides = np.where(left * right > 0, np.minimum(np.abs(left), np.abs(right)), 0.0)
        deviation = np.maximum(deviation, both_sides)
    return deviation


def _without(stretch: RawStretch, fields: list[str], times: FloatArray) -> RawStretch:
    """Return a stretch without the readings of the signals `fields` at `times`."""
    measured = dict(stretch.measured)
    for name in fields:
        is_kept = ~np.isin(measured[name].time, times)
        measured[name] = Signal(measured[name].time[is_kept], measured[name].value[is_kept])
    return replace(stretch, measured=measured)


def check_dead_readings(raw: RawLog, settings: CheckSettings) -> list[Finding]:
    """Return at most one finding: encoders read zero below a speed and have a fine resolution above it."""
    names = [name for name in ("wheel_speeds", "wheels", "twist") if name in raw.stretches[0].measured]
    sizes = [np.abs(np.concatenate([stretch.measured[name].value for stretch in raw.stretches])) for name in names[:1]]
    for size in (column for table in sizes for column in table.T):
        levels, zero_share = np.unique(size[size > 0]), float(np.mean(size == 0))
        if len(levels) < _MIN_READINGS or zero_share < settings.clipped_share:
            continue
        # A dead zone has levels that are finer than the minimum speed, unlike coarse quantisation, and many near it.
        bound = settings.dead_zone_resolution * np.array([levels[0], levels[-1]])
        slow_count = np.count_nonzero(levels < 2.0 * levels[0])
        if np.median(np.diff(levels)) < bound[0] and levels[0] > bound[1] and slow_count >= settings.min_samples:
            unit = "rad/s" if names[0] != "twist" else "m/s or rad/s"
            message = (
                f"the encoders read 0 below {levels[0]:.3g} {unit}, in {100 * zero_share:.0f} % of the readings: the "
                "counting interval is too short; log running counts (`unit: ticks`), or drive faster"
            )
            return [Finding("dead readings", "warning", raw.name, message)]
    return []


def check_resolution(raw: RawLog, settings: CheckSettings) -> list[Finding]:
    """Return notes about positions and speeds of the encoders that are multiples of a coarse step."""
    findings = []
    for name, values in _readings(raw).items():
        step, limit = _step(values), settings.position_step
        if name != "positions":
            limit = settings.significant_change * float(np.nanmax(np.abs(values), initial=0.0))
        if step is not None and step >= limit:
            unit = {"positions": "m", "wheel_speeds": "rad/s", "wheels": "rad/s"}.get(name, "m/s")
            subject = "positions of the pose" if name == "positions" else "speeds of the encoders"
            text = (
                f"the {subject} are multiples of {step:.3g} {unit}: record more decimals, or results are less accurate"
            )
            findings.append(Finding("coarse readings", "note", raw.name, text))
    return findings


def _readings(raw: RawLog) -> dict[str, FloatArray]:
    """Return all positions x, y, and all speeds of the encoders; of a twist, only v."""
    fields = [name for name in ("wheel_speeds", "wheels", "twist") if name in raw.stretches[0].measured][:1]
    fields += ["pose"] if "pose" in raw.stretches[0].measured else []
    tables = {name: np.concatenate([stretch.measured[name].value for stretch in raw.stretches]) for name in fields}
    columns = {"pose": 2, "twist": 1}
    return {
        "positions" if name == "pose" else name: table[:, : columns.get(name, table.shape[1])]
        for name, table in tables.items()
    }


def _step(values: FloatArray) -> float | None:
    """Return the step if all finite values are multiples of it, apart from an offset of each column; else None."""
    columns = [column[np.isfinite(column)] for column in values.T]
    if min(map(len, columns), default=0) < _MIN_READINGS:
        return None
    levels = [np.unique(np.round(column - column[0], 9)) for column in columns]
    steps = [float(np.diff(part).min()) for part in levels if len(part) > 2]
    step = min(steps, default=0.0)
    is_multiple = step > 0 and all(np.allclose(part / step, np.round(part / step), atol=0.01) for part in levels)
    return step if is_multiple else None


def check_publishers(raw: RawLog, settings: CheckSettings) -> list[Finding]:
    """Return at most one finding: commands repeatedly fall to zero for a short time and return."""
    zero_count = total = 0
    for command in (stretch.command for stretch in raw.stretches):
        size, nonzero = np.linalg.norm(command.value, axis=1), np.flatnonzero(command.value.any(axis=1))
        before, after = nonzero[:-1], nonzero[1:]
        change = np.linalg.norm(command.value[after] - command.value[before], axis=1)
        is_short = command.time[after] - command.time[before] < settings.zero_duration
        zero_count += int(np.sum((after - before > 1) & (change < settings.command_change * size[before]) & is_short))
        total += len(nonzero)
    if zero_count < max(settings.min_samples, settings.publisher_share * total):
        return []
    message = (
        f"the command falls to zero {zero_count} times for less than {settings.zero_duration:g} s and returns to its "
        "value: a second publisher sends zeros; stop it (`ros2 topic info -v` lists the publishers), and record again"
    )
    return [Finding("second publisher", "error", raw.name, message)]


def hold_period(readings: FloatArray, settings: CheckSettings) -> int | None:
    """Return the number of rows for which each reading (n, width) is held; None if it is unclear.

    The result is based on the distances between changes. Held readings change after multiples of the period, even if
    their resolution is coarse. If the period is not a whole number of rows, quickly changing readings change after one
    of two adjacent numbers of rows.
    """
    readings = readings[np.isfinite(readings).all(axis=1)]
    changes = 1 + np.flatnonzero((np.diff(readings, axis=0) != 0).any(axis=1))
    gaps = np.diff(changes)
    if len(readings) < _MIN_READINGS or len(gaps) < settings.min_samples:
        return None
    half_window = 4
    padded = np.pad(readings, ((half_window, half_window), (0, 0)), mode="edge")
    # Change over several rows relative to the range; hold times are only visible while the readings change quickly.
    slope = np.max(
        np.abs(padded[2 * half_window :] - padded[: -2 * half_window]) / np.maximum(np.ptp(readings, 0), 1e-12), axis=1
    )
    at_end = slope[changes[1:]]
    quick_gaps = gaps[at_end >= np.percentile(at_end, 80)]
    # The largest period first, because its divisors also divide the gaps.
    for period in range(int(np.percentile(gaps, 90)), 1, -1):
        if np.mean(gaps % period == 0) >= settings.held_share:
            return period
    shorter = int(np.median(quick_gaps))
    for period in (shorter, shorter + 1):
        if period > 2 and np.isin(quick_gaps, [period - 1, period]).mean() >= settings.held_share:
            return period
    return 1 if shorter == 1 else None


def irregular_spacing(readings: FloatArray, settings: CheckSettings) -> str | None:
    """Return the range of rows between two changes, such as "2 to 7", of readings (n, width) that most rows repeat.

    The result is None if fewer rows repeat a reading, or if a coarse resolution may be the cause: then most changes
    are a single step of the resolution.
    """
    readings = readings[np.isfinite(readings).all(axis=1)]
    steps = np.abs(np.diff(readings, axis=0))
    gaps = np.diff(np.flatnonzero((steps > 0).any(axis=1)))
    if len(readings) < _MIN_READINGS or len(gaps) < settings.min_samples or np.median(gaps) < 2:
        return None
    quantiles = np.array([np.percentile(column[column > 0], [5, 50]) for column in steps.T if column.any()])
    if (quantiles[:, 1] < _FINE_STEPS * quantiles[:, 0]).all():
        return None
    low, high = np.percentile(gaps, [10, 90])
    return f"{low:.0f} to {high:.0f}"


def check_stamps(name: str, time: FloatArray, readings: FloatArray, settings: CheckSettings) -> Finding | None:
    """Return the finding if the stamps (n,) [s] of the rows are unusable; None for regular stamps.

    Parameters
    ----------
    name
        Name of the log.
    time, readings
        (n,) stamps [s], and (n,) a measured signal in the order of the rows; its smoothness indicates the true order.
    settings
        The thresholds.
    """
    steps = np.diff(time)
    if len(steps) < settings.min_samples:
        return None
    backward_count = int((steps < 0).sum())
    if backward_count > max(3.0, settings.backward_share * len(steps)):
        # Readings are smooth in their true order; a reversed log is as smooth by time.
        order = np.argsort(time, kind="stable")
        row_variation, time_variation = (
            float(np.nansum(np.abs(np.diff(part)))) for part in (readings, readings[order])
        )
        is_reversed = backward_count > (1.0 - settings.backward_share) * len(steps)
        is_sortable = is_reversed or time_variation <= row_variation
        mean_step = float(np.ptp(time)) / len(steps)
        remedy = "sort the rows by their time" if is_sortable else "the rows are in order and the stamps are not"
        message = f"time runs backwards {backward_count} times in {len(steps)} steps: {remedy}"
        changes = () if is_sortable else (MappingChange("time", "sample_time", float(f"{mean_step:.4g}")),)
        return Finding("shuffled stamps", "error", name, message, changes=changes)
    typical = float(np.median(steps))
    forward = steps[(steps > 0) & (steps < settings.clock_jump)]
    if not len(forward):
        return None
    pause = float(np.percentile(forward, 99))
    inside = steps < settings.clock_jump
    mean_step = float(steps[inside].sum() / inside.sum())
    if typical < settings.burst_step * mean_step and pause > 2 * mean_step:
        message = (
            f"stamps come in bursts: most steps are {typical:.2g} s, with pauses of {pause:.2g} s and a mean of "
            f"{mean_step:.3g} s; the rows were stamped when they were written, not when the sensors were read"
        )
        changes = (MappingChange("time", "sample_time", float(f"{mean_step:.3g}")),)
        return Finding("bursty stamps", "error", name, message, changes=changes)
    return None


def check_period(name: str, period: float, settings: CheckSettings, mapping: LogMapping) -> Finding | None:
    """Return the finding for an implausible sample time [s]; None for a plausible one.

    A sample time that the mapping states is corrected itself, because there is no column of times.
    """
    low, high = settings.sample_times
    if low <= period <= high:
        return None
    time = mapping.columns.time if mapping.columns else None
    steps = {unit: period * FACTORS[unit] / FACTORS[time.unit if time else "s"] for unit in get_args(TimeUnit)}
    units = [unit for unit, step in steps.items() if low <= step <= high]
    hint = "" if units and mapping.columns else ": check the times and their unit"
    message = f"the times step by {period:.4g} s, which is not a plausible sample time of a robot{hint}"
    remedy: tuple[MappingChange, ...] = ()
    if units and time:
        remedy = (MappingChange("time", "unit", units[0]),)
    elif units and mapping.columns:
        remedy = (MappingChange("time", "sample_time", float(f"{steps[units[0]]:.4g}")),)
    return Finding("wrong unit", "error", name, message, changes=remedy)


def in_degrees(heading: FloatArray) -> bool:
    """Return True if the steps of headings (n,) that are declared as radians indicate degrees.

    Between readings, headings in radians change by less than 1.5 modulo a full turn, and headings in degrees by up to
    360. Headings with a range of less than 10 count as radians, because poses also leap when they restart.
    """
    heading = heading[np.isfinite(heading)]
    steps = np.abs(np.diff(heading))[heading[1:] != 0]  # zero is the heading after a restart
    steps = steps[steps > 0]
    wrapped_steps = np.abs(steps - 2 * np.pi * np.round(steps / (2 * np.pi)))
    full_turn = np.abs(steps - 360.0) < 20.0
    leaps = len(steps) > 0 and (full_turn.any() or np.mean((wrapped_steps > 1.5) | (steps > 50)) > 0.003)
    return bool(leaps and np.ptp(heading) > 10.0)
