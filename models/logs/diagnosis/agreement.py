"""Agreement of the parts of a log, and of several logs, in gains and delays of one robot."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy import special

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.check_settings import CheckSettings
from diffdrive_mpc.models.logs.diagnosis.streams import COMMAND, ENCODERS, GYRO, POSE, Streams, fit_response, paired
from diffdrive_mpc.models.logs.record import Finding, MappingChange
from diffdrive_mpc.models.velocity_model import CHANNELS


@dataclass(frozen=True)
class Relation:
    """One stream over another, part by part of a log.

    Attributes
    ----------
    first, second
        Names of the streams; the second over the first is the gain.
    channel
        0 for v, 1 for omega.
    gains, times
        (parts,) gains, and when each part begins [s].
    response
        Dead time and lags from a command [s]; NaN between sensors.
    """

    first: str
    second: str
    channel: int
    gains: FloatArray
    times: FloatArray
    response: float

    @property
    def label(self) -> str:
        """In words."""
        return f"{CHANNELS[self.channel]} of the {self.second} over that of the {self.first}"


def relations(streams: Streams, settings: CheckSettings) -> list[Relation]:
    """Return all pairs of streams that follow each other clearly."""
    pairs = []
    for channel in (0, 1):
        for first, second in combinations([COMMAND, *streams.present(channel)], 2):
            a, b = streams.pair(first, second, channel)
            how = fit_response(streams, a, b, settings, both_measured=first != COMMAND)
            if how is None or how.correlation[0] < settings.weak_correlation:
                continue
            shift = round(how.dead_time / streams.dt)
            gains, times = _by_part(streams, streams.lagged(a, how.lag), b, shift, settings)
            if len(gains):
                response = how.delay if first == COMMAND else np.nan
                pairs.append(Relation(first, second, channel, gains, times, response))
    return pairs


def _by_part(
    streams: Streams, u: FloatArray, y: FloatArray, shift: int, settings: CheckSettings
) -> tuple[FloatArray, FloatArray]:
    """Compute gains of y over u in parts with equal excitation, and the starts of these parts [s]."""
    both = np.column_stack([u, streams.time])
    left, right = paired(both, y, shift)
    u, time, y = left[:, 0], left[:, 1], right
    if len(u) < 2 * settings.parts or u @ u == 0:
        return np.empty(0), np.empty(0)
    u, y = u - u.mean(), y - y.mean()
    energy = np.cumsum(u**2) / (u @ u)
    edges = np.searchsorted(energy, np.linspace(0, 1, settings.parts + 1)[1:-1])
    gains, times = [], []
    for part in np.split(np.arange(len(u)), edges):
        # A part with an almost constant stream does not determine a gain.
        if len(part) > 2 and np.var(u[part]) > settings.least_part_change * np.var(u):
            slope = np.cov(u[part], y[part])[0, 1] / np.var(u[part], ddof=1)
            if slope > 0:
                gains.append(slope)
                times.append(time[part[0]])
    return np.array(gains), np.array(times)


def check_jumps(log: str, streams: Streams, settings: CheckSettings) -> list[Finding]:
    """Return at most one finding: a stream whose magnitude jumps within the log as no robot's does."""
    known = np.flatnonzero(np.isfinite(streams.time))
    parts = np.array_split(known, settings.parts)
    times = np.array([streams.time[part[0]] for part in parts if len(part)])
    if len(times) < settings.parts:
        return []
    pairs = []
    for channel in (0, 1):
        sizes = {
            name: np.array([_rms(streams.channel(name, channel), part) for part in parts])
            for name in (COMMAND, *streams.present(channel))
        }
        for first, second in combinations(sizes, 2):
            a, b = sizes[first], sizes[second]
            driven = (a > 0) & (b > 0)
            if driven.sum() > settings.parts // 2:
                # One of the two keeps its magnitude; if both are small, the robot rests.
                driven &= (a > 0.3 * np.median(a[driven])) | (b > 0.3 * np.median(b[driven]))
                pairs.append(Relation(first, second, channel, b[driven] / a[driven], times[driven], np.nan))
    return _changed(log, pairs, settings.unit_change, settings)


def _rms(values: FloatArray | None, part: NDArray[np.intp]) -> float:
    """Compute the root mean square of the finite values (N,) of a part; 0 if most are not finite."""
    assert values is not None
    finite = values[part][np.isfinite(values[part])]
    return float(np.sqrt(np.mean(finite**2))) if 2 * len(finite) > len(part) else 0.0


def check_parts(log: str, streams: Streams, settings: CheckSettings) -> list[Finding]:
    """Return at most one finding: a stream whose scale changes within the log, or commands whose gain drifts."""
    pairs = relations(streams, settings)
    return _changed(log, pairs, settings.scale_change, settings) or _drift(log, pairs, settings)


def _drift(log: str, pairs: Sequence[Relation], settings: CheckSettings) -> list[Finding]:
    """Return the finding for a response to commands that grows or falls over the whole log."""
    drifts = []
    for relation in pairs:
        if relation.first != COMMAND or relation.second == POSE or len(relation.gains) < settings.parts // 2:
            continue
        gains, times = np.log(relation.gains), relation.times
        slope, chance = _trend(gains, times, settings)
        if abs(slope) > max(np.log(settings.gain_drift), chance):
            ends = (times[[0, -1]] - times.mean()) / np.ptp(times)
            drifts.append((relation, gains.mean() + slope * ends))
    if not drifts:
        return []
    relation, ends = max(drifts, key=lambda drift: abs(drift[1][1] - drift[1][0]))
    first, last = np.exp(ends)
    words = (
        f"{relation.label} {'falls' if last < first else 'grows'} steadily from {first:.3g} to {last:.3g} along the "
        "log: a battery that sags, or motors that warm up; record with a full battery, or identify from a part"
    )
    return [Finding("gain drift", "warning", log, words)]


def check_turning(log: str, streams: Streams, settings: CheckSettings) -> list[Finding]:
    """Return at most one finding: a wheel whose rolling radius changes within the log, or a drifting bias of the gyro.

    In each part the body's yaw rate is regressed on that of a reference, the speed of the wheels, and a constant. The
    speed enters by unequal radii of the wheels.
    """
    bodies = [name for name in (GYRO, POSE) if name in streams.present(1)]
    if ENCODERS not in streams.present(1) or not bodies:
        return []
    parts = np.array_split(np.flatnonzero(np.isfinite(streams.time)), settings.parts)
    v, turn = (streams.smoothed(np.asarray(streams.channel(ENCODERS, channel))) for channel in (0, 1))
    body = np.asarray(streams.channel(bodies[0], 1))
    body = body if bodies[0] == POSE else streams.smoothed(body)
    rows = np.column_stack([turn, v, np.ones(len(v)), body])
    inside = [rows[part][np.isfinite(rows[part]).all(axis=1)] for part in parts]
    if any(len(part) < settings.fewest_samples or not np.ptp(part[:, :2], axis=0).all() for part in inside):
        return []
    by = np.array([np.linalg.lstsq(part[:, :3], part[:, 3], rcond=None)[0] for part in inside])
    times = np.array([streams.time[part[0]] for part in parts])
    change = _change(by[:, 1], settings.certain)
    effect = np.sqrt(np.nanmean(v**2) / max(float(np.nanmean((by[:, 0].mean() * turn) ** 2)), 1e-12))
    if change and abs(change[1]) > max(change[2], settings.tyre_change / effect):
        index, size, _ = change
        words = (
            f"from about {times[index]:.0f} s on the body turns {'left' if size > 0 else 'right'} by "
            f"{abs(size):.2g} rad per m more than its wheels say: the {'left' if size > 0 else 'right'} tyre lost air, "
            "or its encoder changed; mend it, cut the log there and identify from one part"
        )
        return [Finding("tyre change", "warning", log, words, *cut(times, index))]
    if GYRO not in bodies:
        return []
    if POSE in bodies:
        rows[:, 0] = streams.pair(GYRO, POSE, 1)[1]
    known = np.isfinite(rows).all(axis=1)
    rest = rows[:, 3] - rows[:, :3] @ np.linalg.lstsq(rows[known, :3], rows[known, 3], rcond=None)[0]
    inside = [rest[part][known[part]] for part in parts]
    if not all(map(len, inside)):
        return []
    slope, chance = _trend(np.array([part.mean() for part in inside]), times, settings)
    if abs(slope) < max(chance, settings.bias_drift):
        return []
    words = (
        f"the bias of the gyro drifts by {slope:.2g} rad/s along the log: let it warm up for some minutes, and set its "
        "zero again before the log"
    )
    return [Finding("gyro drift", "warning", log, words)]


def _trend(values: FloatArray, times: FloatArray, settings: CheckSettings) -> tuple[float, float]:
    """Return the change of values (n,) from the first of `times` to the last by a line, and the size of chance."""
    rows = np.column_stack([np.ones(len(times)), (times - times.mean()) / np.ptp(times)])
    by = np.linalg.lstsq(rows, values, rcond=None)[0]
    rest, free = values - rows @ by, len(values) - 2
    deviation = float(np.sqrt(rest @ rest / free / (rows[:, 1] @ rows[:, 1])))
    return float(by[1]), deviation * float(-special.stdtrit(free, special.ndtr(-settings.certain)))


def _changed(log: str, pairs: Sequence[Relation], least: float, settings: CheckSettings) -> list[Finding]:
    """Return the finding for the stream whose gains change by more than the factor `least` at one time."""
    changes: list[tuple[Relation, int, float]] = []
    steady: list[Relation] = []
    for relation in pairs:
        change = _change(np.log(relation.gains), settings.certain)
        if change and abs(change[1]) > max(np.log(least), change[2]):
            changes.append((relation, change[0], change[1]))
        else:
            steady.append(relation)
    if not changes:
        return []
    counts: dict[str, int] = {}
    for relation, _, _ in changes:
        for name in (relation.first, relation.second):
            counts[name] = counts.get(name, 0) + 1
    for relation in steady:
        for name in (relation.first, relation.second):
            counts[name] = counts.get(name, 0) - 1
    # Of two that disagree, the sensor is named: a robot's response may change, its commands do not.
    name = max(counts, key=lambda key: (counts[key], key != COMMAND))
    relation, index, size = max(
        (change for change in changes if name in (change[0].first, change[0].second)), key=lambda change: abs(change[2])
    )
    before, after = (float(np.exp(np.mean(np.log(part)))) for part in (relation.gains[:index], relation.gains[index:]))
    words = (
        f"the scale of the {name} changes by a factor of "
        f"{np.exp(size if relation.second == name else -size):.3g} at about {relation.times[index]:.0f} s: "
        f"{relation.label} is {before:.3g} before and {after:.3g} after; cut the log there and identify from one part"
    )
    return [Finding("scale change", "error", log, words, *cut(relation.times, index))]


def cut(times: FloatArray, index: int) -> tuple[tuple[float, float], tuple[MappingChange, ...]]:
    """Return the span [s] of a change before part `index`, for parts that start at `times` [s], and the cut.

    The longer side is kept, without the parts in which the change may lie.
    """
    after = min(index + 1, len(times) - 1)
    end = float(2 * times[-1] - times[-2])
    before, behind = (float(times[0]), float(times[index - 1])), (float(times[after]), end)
    longest = max(before, behind, key=lambda span: span[1] - span[0])
    change = MappingChange("log", "times", f"{longest[0]:.1f} to {longest[1]:.1f}")
    return (float(times[index - 1]), float(times[after])), (change,)


def _change(values: FloatArray, certain: float) -> tuple[int, float, float] | None:
    """Find a change of level in a row of values: place, size, and the size of chance; None for too few values.

    Few values know their scatter badly: chance is as rare as `certain` standard deviations of a known one (Student).
    """
    best: tuple[float, int, float, float] | None = None
    for index in range(2, len(values) - 1):
        left, right = values[:index], values[index:]
        inside = float(((left - left.mean()) ** 2).sum() + ((right - right.mean()) ** 2).sum())
        deviation = np.sqrt(inside / (len(values) - 2) * (1 / len(left) + 1 / len(right)))
        if best is None or inside < best[0]:
            best = (inside, index, float(right.mean() - left.mean()), float(deviation))
    if best is None:
        return None
    _, index, change, deviation = best
    return index, change, deviation * float(-special.stdtrit(len(values) - 2, special.ndtr(-certain)))


def compare(
    first: str,
    second: str,
    first_relations: Sequence[Relation],
    second_relations: Sequence[Relation],
    settings: CheckSettings,
) -> list[Finding]:
    """Return at most one finding: gains or delays of two logs that no drive of one robot explains."""
    for a in first_relations:
        b = next(
            (b for b in second_relations if (b.first, b.second, b.channel) == (a.first, a.second, a.channel)), None
        )
        if b is None or POSE in (a.first, a.second):
            continue
        low, high = np.log(a.gains), np.log(b.gains)
        apart = float(high.mean() - low.mean())
        deviation = float(np.hypot(*(part.std() / np.sqrt(len(part)) for part in (low, high))))
        slower = abs(a.response - b.response)
        gain = abs(apart) > max(np.log(settings.same_gain), settings.certain * deviation)
        if not gain and not slower > settings.same_response:
            continue
        means = [float(np.exp(part.mean())) for part in (low, high)]
        words = (
            f"{a.label} is {means[0]:.3g} in {first} and {means[1]:.3g} in {second}"
            if gain
            else f"{CHANNELS[a.channel]} answers after {a.response:.2f} s in {first} and {b.response:.2f} s in {second}"
        )
        words += ": two robots, loads or mappings? Identify each by itself"
        return [Finding("different logs", "warning", f"{first}, {second}", words)]
    return []
