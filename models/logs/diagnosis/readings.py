"""Faults of single readings and stamps: spikes, held values, plateaus, shuffled and bursty clocks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.check_settings import CheckSettings
from diffdrive_mpc.models.logs.record import BoolArray, Finding, MappingChange
from diffdrive_mpc.models.logs.sampling import RawLog, RawStretch, Signal

_SENSOR = {"twist": "encoders", "wheels": "encoders", "wheel_speeds": "encoders", "yaw_rate": "gyro", "pose": "pose"}
_FEWEST = 100
"""Number of readings below which spikes and held values are not judged."""


def without_spikes(raw: RawLog, settings: CheckSettings) -> RawLog:
    """Remove readings far off from those right before and after, with a finding per sensor."""
    findings = []
    stretches = list(raw.stretches)
    for sensor in ("encoders", "gyro", "pose"):
        fields = [name for name in raw.stretches[0].measured if _SENSOR.get(name) == sensor]
        if not fields:
            continue
        masks = [_spikes([stretch.measured[name].value for stretch in stretches], settings) for name in fields]
        # Compare by time: with a missing cell, one signal of a sensor has one reading less than the others.
        hit = [
            np.unique(
                np.concatenate([stretch.measured[name].time[part] for name, part in zip(fields, parts, strict=True)])
            )
            for stretch, *parts in zip(stretches, *masks, strict=True)
        ]
        count = sum(len(times) for times in hit)
        total = sum(max(len(stretch.measured[name].time) for name in fields) for stretch in stretches)
        if not count or count > settings.most_spikes * total:
            continue
        first = next(times[0] for times in hit if len(times))
        words = (
            f"{count} readings of the {sensor} ({100 * count / total:.2g} %) stand far off from those before "
            "and after: "
            "spikes; they are left out"
        )
        findings.append(Finding("spikes", "warning", f"{raw.name}, first at {first:.1f} s", words))
        stretches = [_without(stretch, fields, part) for stretch, part in zip(stretches, hit, strict=True)]
    return replace(raw, stretches=tuple(stretches), findings=(*raw.findings, *findings))


def _spikes(values: list[FloatArray], settings: CheckSettings) -> list[BoolArray]:
    """Mark (n,) one or two readings of each stretch that leap out and back by more than readings do."""
    off = [_leaps(part) for part in values]
    together, readings = np.concatenate(off), np.concatenate(values)
    if len(together) < _FEWEST:
        return [np.zeros(len(part), dtype=bool) for part in values]
    usual = np.percentile(together, 95, axis=0)
    span = np.ptp(np.percentile(readings, [5, 95], axis=0), axis=0)
    bound = np.maximum(settings.spike_scatter * usual, settings.spike_span * span)
    return [((part > bound) & (bound > 0)).any(axis=1) for part in off]


def _leaps(values: FloatArray) -> FloatArray:
    """Compute the distance (n, width) of readings to the same side from those one or two before and after."""
    leap = np.zeros_like(values)
    if not len(values):
        return leap  # a stretch in which the sensor was silent
    padded = np.pad(values, ((2, 2), (0, 0)), mode="edge")
    count = len(values)
    for before, after in ((1, 1), (1, 2), (2, 1)):
        left, right = (values - padded[2 + k : 2 + k + count] for k in (-before, after))
        leap = np.maximum(leap, np.where(left * right > 0, np.minimum(np.abs(left), np.abs(right)), 0.0))
    return leap


def _without(stretch: RawStretch, fields: list[str], times: FloatArray) -> RawStretch:
    """Remove the readings of a sensor's signals at these times from a stretch."""
    measured = dict(stretch.measured)
    for name in fields:
        keep = ~np.isin(measured[name].time, times)
        measured[name] = Signal(measured[name].time[keep], measured[name].value[keep])
    return replace(stretch, measured=measured)


def check_dead_readings(raw: RawLog, settings: CheckSettings) -> list[Finding]:
    """Return at most one finding: encoders that read exactly zero below a speed, and resolve finer steps above it."""
    names = [name for name in ("wheel_speeds", "wheels", "twist") if name in raw.stretches[0].measured]
    sizes = [np.abs(np.concatenate([stretch.measured[name].value for stretch in raw.stretches])) for name in names[:1]]
    for size in (column for table in sizes for column in table.T):
        turning, still = np.unique(size[size > 0]), float(np.mean(size == 0))
        if len(turning) < _FEWEST or still < settings.clipped_readings:
            continue
        # Readings that pass through zero are as frequent below the least speed as above it; coarse ones are multiples.
        bound = settings.dead_resolution * np.array([turning[0], turning[-1]])
        slow = np.count_nonzero(turning < 2.0 * turning[0])
        if np.median(np.diff(turning)) < bound[0] and turning[0] > bound[1] and slow >= settings.fewest_samples:
            unit = "rad/s" if names[0] != "twist" else "m/s or rad/s"
            words = (
                f"the encoders read 0 below {turning[0]:.3g} {unit}, in {100 * still:.0f} % of the readings: they "
                "count over too short a time; log running counts (`unit: ticks`), or drive faster than that"
            )
            return [Finding("dead readings", "warning", raw.name, words)]
    return []


def check_publishers(raw: RawLog, settings: CheckSettings) -> list[Finding]:
    """Return at most one finding: commands that fall to zero for a moment, again and again, and return."""
    moments = total = 0
    for command in (stretch.command for stretch in raw.stretches):
        size, driven = np.linalg.norm(command.value, axis=1), np.flatnonzero(command.value.any(axis=1))
        before, after = driven[:-1], driven[1:]
        moved = np.linalg.norm(command.value[after] - command.value[before], axis=1)
        is_short = command.time[after] - command.time[before] < settings.longest_moment
        moments += int(np.sum((after - before > 1) & (moved < settings.same_command * size[before]) & is_short))
        total += len(driven)
    if moments < max(settings.fewest_samples, settings.publisher_share * total):
        return []
    words = (
        f"the command falls to zero {moments} times for less than {settings.longest_moment:g} s and returns to its "
        "value: a second publisher sends zeros; stop it (`ros2 topic info -v` lists the publishers), and record again"
    )
    return [Finding("second publisher", "error", raw.name, words)]


def hold_period(readings: FloatArray, settings: CheckSettings) -> int | None:
    """Find the number of rows for which each reading (n, width) is held; 1 without holds, None if unclear.

    It shows where readings change. Held ones change after one period or a multiple of it, however coarse they are; a
    period that is no whole number of rows, after one of two neighbours while the sensor changes quickly.
    """
    readings = readings[np.isfinite(readings).all(axis=1)]
    changes = 1 + np.flatnonzero((np.diff(readings, axis=0) != 0).any(axis=1))
    gaps = np.diff(changes)
    if len(readings) < _FEWEST or len(gaps) < settings.fewest_samples:
        return None
    reach = 4
    padded = np.pad(readings, ((reach, reach), (0, 0)), mode="edge")
    slope = np.max(np.abs(padded[2 * reach :] - padded[: -2 * reach]) / np.maximum(np.ptp(readings, 0), 1e-12), axis=1)
    at_end = slope[changes[1:]]
    quick = gaps[at_end >= np.percentile(at_end, 80)]
    for period in range(int(np.percentile(gaps, 90)), 1, -1):
        if np.mean(gaps % period == 0) >= settings.held_share:
            return period
    shorter = int(np.median(quick))
    for period in (shorter, shorter + 1):
        if period > 2 and np.isin(quick, [period - 1, period]).mean() >= settings.held_share:
            return period
    return 1 if shorter == 1 else None


def check_stamps(name: str, time: FloatArray, readings: FloatArray, settings: CheckSettings) -> Finding | None:
    """Return the finding that makes stamps (n,) [s] of the rows useless; None for stamps that run forward evenly.

    Parameters
    ----------
    name
        Name of the log.
    time, readings
        Stamps, and (n,) one measured signal in the order of the rows, by whose smoothness the order is judged.
    settings
        The thresholds.
    """
    steps = np.diff(time)
    if len(steps) < settings.fewest_samples:
        return None
    back = int((steps < 0).sum())
    if back > max(3.0, settings.disordered * len(steps)):
        order = np.argsort(time, kind="stable")
        as_written, in_order = (float(np.nansum(np.abs(np.diff(part)))) for part in (readings, readings[order]))
        usual = float(np.ptp(time)) / len(steps)
        remedy = (
            "sort the rows by their time" if in_order <= as_written else "the rows are in order and the stamps are not"
        )
        words = f"time runs backwards {back} times in {len(steps)} steps: {remedy}"
        by_rows = () if in_order <= as_written else (MappingChange("time", "sample_time", float(f"{usual:.4g}")),)
        return Finding("shuffled stamps", "error", name, words, changes=by_rows)
    typical = float(np.median(steps))
    forward = steps[(steps > 0) & (steps < settings.clock_jump)]
    if not len(forward):
        return None
    pause = float(np.percentile(forward, 99))
    inside = steps < settings.clock_jump
    usual = float(steps[inside].sum() / inside.sum())
    if typical < settings.burst_step * usual and pause > 2 * usual:
        words = (
            f"stamps come in bursts: most steps are {typical:.2g} s, then {pause:.2g} s pass, {usual:.3g} s "
            "on average; the rows were stamped when they were written, not when they were read"
        )
        by_rows = (MappingChange("time", "sample_time", float(f"{usual:.3g}")),)
        return Finding("bursty stamps", "error", name, words, changes=by_rows)
    return None


def check_period(name: str, period: float, settings: CheckSettings) -> Finding | None:
    """Return the finding for a sample time [s] that no log of a robot has; None otherwise."""
    low, high = settings.sample_times
    if low <= period <= high:
        return None
    units = [unit for unit, scale in (("ms", 1e-3), ("us", 1e-6), ("ns", 1e-9)) if low <= period * scale <= high]
    question = "" if units else ": is it the right column, in the right unit?"
    words = f"the times step by {period:.4g} s, which is no sample time of a robot{question}"
    remedy = tuple(MappingChange("time", "unit", unit) for unit in units[:1])
    return Finding("wrong unit", "error", name, words, changes=remedy)


def in_degrees(heading: FloatArray) -> bool:
    """Return True if headings (n,) declared as radians have the steps of degrees.

    From one reading to the next radians change by less than one and a half, or by a full turn; degrees by anything
    up to 360.
    """
    steps = np.abs(np.diff(heading[np.isfinite(heading)]))
    steps = steps[steps > 0]
    turns = np.abs(steps - 2 * np.pi * np.round(steps / (2 * np.pi)))
    full_turn = np.abs(steps - 360.0) < 20.0
    return len(steps) > 0 and bool(full_turn.any() or np.mean((turns > 1.5) | (steps > 50)) > 0.003)
