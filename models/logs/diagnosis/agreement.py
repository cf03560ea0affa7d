"""Consistency of gains and delays between the parts of a log and between logs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy import special

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.check_settings import CheckSettings
from diffdrive_mpc.models.logs.diagnosis.streams import (
    COMMAND,
    ENCODERS,
    GYRO,
    POSE,
    Streams,
    finite_pairs,
    fit_response,
)
from diffdrive_mpc.models.logs.record import Finding, MappingChange
from diffdrive_mpc.models.velocity_model import CHANNELS


@dataclass(frozen=True)
class Relation:
    """Ratio of one stream to another in each part of a log.

    Attributes
    ----------
    first, second
        Names of the streams; the gain is the ratio of the second to the first.
    channel
        0 for v, 1 for omega.
    gains, times
        (parts,) gains and start times of the parts [s].
    response
        Dead time plus lags after a command [s]; NaN between sensors.
    """

    first: str
    second: str
    channel: int
    gains: FloatArray
    times: FloatArray
    response: float

    @property
    def label(self) -> str:
        """Name of the gain for messages."""
        return f"{CHANNELS[self.channel]} of the {self.second} over that of the {self.first}"


def relations(streams: Streams, settings: CheckSettings) -> list[Relation]:
    """Compute the relations of all pairs of streams with sufficient correlation."""
    pairs = []
    for channel in (0, 1):
        for first, second in combinations([COMMAND, *streams.sensors(channel)], 2):
            a, b = streams.pair(first, second, channel)
            fit = fit_response(streams, a, b, settings, both_measured=first != COMMAND)
            if fit is None or fit.correlation[0] < settings.weak_correlation:
                continue
            shift = round(fit.dead_time / streams.dt)
            gains, times = _gains_by_part(streams, streams.low_pass(a, fit.lag), b, shift, settings)
            if len(gains):
                response = fit.delay if first == COMMAND else np.nan
                pairs.append(Relation(first, second, channel, gains, times, response))
    return pairs


def _gains_by_part(
    streams: Streams, u: FloatArray, y: FloatArray, shift: int, settings: CheckSettings
) -> tuple[FloatArray, FloatArray]:
    """Compute the gains from u to y in parts with equal excitation, and the start times of the parts [s]."""
    both = np.column_stack([u, streams.time])
    left, right = finite_pairs(both, y, shift)
    u, time, y = left[:, 0], left[:, 1], right
    if len(u) < 2 * settings.part_count or u @ u == 0:
        return np.empty(0), np.empty(0)
    u, y = u - u.mean(), y - y.mean()
    # Parts have equal excitation instead of equal duration, so that their gains are equally accurate.
    energy = np.cumsum(u**2) / (u @ u)
    edges = np.searchsorted(energy, np.linspace(0, 1, settings.part_count + 1)[1:-1])
    gains, times = [], []
    for part in np.split(np.arange(len(u)), edges):
        # A part with an almost constant stream does not determine a gain.
        if len(part) > 2 and np.var(u[part]) > settings.min_part_variance * np.var(u):
            slope = np.cov(u[part], y[part])[0, 1] / np.var(u[part], ddof=1)
            if slope > 0:
                gains.append(slope)
                times.append(time[part[0]])
    return np.array(gains), np.array(times)


def check_jumps(log: str, streams: Streams, settings: CheckSettings) -> list[Finding]:
    """Return at most one finding: the rms value of a stream changes implausibly within the log."""
    known = np.flatnonzero(np.isfinite(streams.time))
    parts = np.array_split(known, settings.part_count)
    times = np.array([streams.time[part[0]] for part in parts if len(part)])
    if len(times) < settings.part_count:
        return []
    pairs = []
    for channel in (0, 1):
        rms_values = {
            name: np.array([_rms(streams.channel(name, channel), part) for part in parts])
            for name in (COMMAND, *streams.sensors(channel))
        }
        for first, second in combinations(rms_values, 2):
            a, b = rms_values[first], rms_values[second]
            is_moving = (a > 0) & (b > 0)
            if is_moving.sum() > settings.part_count // 2:
                # If both rms values are small, the robot is at rest and their ratio is noise.
                is_moving &= (a > 0.3 * np.median(a[is_moving])) | (b > 0.3 * np.median(b[is_moving]))
                pairs.append(Relation(first, second, channel, b[is_moving] / a[is_moving], times[is_moving], np.nan))
    return _scale_finding(log, pairs, settings.unit_change, settings)


def _rms(values: FloatArray | None, part: NDArray[np.intp]) -> float:
    """Compute the root mean square of the finite values (N,) of a part; 0 if at least half of them are not finite."""
    assert values is not None
    finite = values[part][np.isfinite(values[part])]
    return float(np.sqrt(np.mean(finite**2))) if 2 * len(finite) > len(part) else 0.0


def check_parts(log: str, streams: Streams, settings: CheckSettings) -> list[Finding]:
    """Return at most one finding: the scale of a stream changes within the log, or the gain from a command drifts."""
    pairs = relations(streams, settings)
    return _scale_finding(log, pairs, settings.scale_change, settings) or _drift_finding(log, pairs, settings)


def _drift_finding(log: str, pairs: Sequence[Relation], settings: CheckSettings) -> list[Finding]:
    """Return the finding if the gain from a command to a sensor drifts over the whole log."""
    drifts = []
    for relation in pairs:
        if relation.first != COMMAND or relation.second == POSE or len(relation.gains) < settings.part_count // 2:
            continue
        gains, times = np.log(relation.gains), relation.times
        slope, threshold = _trend(gains, times, settings)
        if abs(slope) > max(np.log(settings.gain_drift), threshold):
            ends = (times[[0, -1]] - times.mean()) / np.ptp(times)
            drifts.append((relation, gains.mean() + slope * ends))
    if not drifts:
        return []
    relation, ends = max(drifts, key=lambda drift: abs(drift[1][1] - drift[1][0]))
    first, last = np.exp(ends)
    message = (
        f"{relation.label} {'decreases' if last < first else 'increases'} from {first:.3g} to {last:.3g} "
        "along the log: the battery discharges, or the motors warm up; record with a full battery, or identify from "
        "part of the log"
    )
    return [Finding("gain drift", "warning", log, message)]


def check_turning(log: str, streams: Streams, settings: CheckSettings) -> list[Finding]:
    """Return at most one finding: the rolling radius of a wheel changes within the log, or the gyro's bias drifts.

    In each part, the yaw rate of the body is regressed on the yaw rate and the speed of the wheels and a constant. The
    coefficient of the speed differs from zero if the wheel radii are unequal.
    """
    bodies = [name for name in (GYRO, POSE) if name in streams.sensors(1)]
    if ENCODERS not in streams.sensors(1) or not bodies:
        return []
    parts = np.array_split(np.flatnonzero(np.isfinite(streams.time)), settings.part_count)
    v, yaw_rate = (streams.smooth(np.asarray(streams.channel(ENCODERS, channel))) for channel in (0, 1))
    body = np.asarray(streams.channel(bodies[0], 1))
    body = body if bodies[0] == POSE else streams.smooth(body)
    rows = np.column_stack([yaw_rate, v, np.ones(len(v)), body])
    part_rows = [rows[part][np.isfinite(rows[part]).all(axis=1)] for part in parts]
    if any(len(part) < settings.min_samples or not np.ptp(part[:, :2], axis=0).all() for part in part_rows):
        return []
    coefficients = np.array([np.linalg.lstsq(part[:, :3], part[:, 3], rcond=None)[0] for part in part_rows])
    times = np.array([streams.time[part[0]] for part in parts])
    change = _detect_change(coefficients[:, 1], settings.significance)
    effect = np.sqrt(np.nanmean(v**2) / max(float(np.nanmean((coefficients[:, 0].mean() * yaw_rate) ** 2)), 1e-12))
    if change and abs(change[1]) > max(change[2], settings.tyre_change / effect):
        index, size, _ = change
        message = (
            f"from about {times[index]:.0f} s on the body turns {'left' if size > 0 else 'right'} by "
            f"{abs(size):.2g} rad per m more than its wheels indicate: the {'left' if size > 0 else 'right'} tyre lost "
            "air, or its encoder changed; repair it, split the log there and identify from one part"
        )
        return [Finding("tyre change", "warning", log, message, *change_location(times, index))]
    if GYRO not in bodies:
        return []
    # If there is a pose, its yaw rate replaces that of the wheels, because it does not depend on slip.
    if POSE in bodies:
        rows[:, 0] = streams.pair(GYRO, POSE, 1)[1]
    known = np.isfinite(rows).all(axis=1)
    residual = rows[:, 3] - rows[:, :3] @ np.linalg.lstsq(rows[known, :3], rows[known, 3], rcond=None)[0]
    part_rows = [residual[part][known[part]] for part in parts]
    if not all(map(len, part_rows)):
        return []
    slope, threshold = _trend(np.array([part.mean() for part in part_rows]), times, settings)
    if abs(slope) < max(threshold, settings.bias_drift):
        return []
    message = (
        f"the bias of the gyro drifts by {slope:.2g} rad/s along the log: let it warm up for some minutes and "
        "calibrate its zero before recording"
    )
    return [Finding("gyro drift", "warning", log, message)]


def _trend(values: FloatArray, times: FloatArray, settings: CheckSettings) -> tuple[float, float]:
    """Fit a line to values (n,) at `times` (n,) [s]; return its total change and the threshold of significance."""
    rows = np.column_stack([np.ones(len(times)), (times - times.mean()) / np.ptp(times)])
    coefficients = np.linalg.lstsq(rows, values, rcond=None)[0]
    residual, freedom = values - rows @ coefficients, len(values) - 2
    deviation = float(np.sqrt(residual @ residual / freedom / (rows[:, 1] @ rows[:, 1])))
    return float(coefficients[1]), deviation * float(-special.stdtrit(freedom, special.ndtr(-settings.significance)))


def _scale_finding(log: str, pairs: Sequence[Relation], min_ratio: float, settings: CheckSettings) -> list[Finding]:
    """Return the finding for the stream whose gains change by more than the factor `min_ratio` at one time."""
    changes: list[tuple[Relation, int, float]] = []
    steady: list[Relation] = []
    for relation in pairs:
        change = _detect_change(np.log(relation.gains), settings.significance)
        if change and abs(change[1]) > max(np.log(min_ratio), change[2]):
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
    # In a tie, select the sensor, because the response of a robot may change and the scale of its commands does not.
    name = max(counts, key=lambda key: (counts[key], key != COMMAND))
    relation, index, size = max(
        (change for change in changes if name in (change[0].first, change[0].second)), key=lambda change: abs(change[2])
    )
    before, after = (float(np.exp(np.mean(np.log(part)))) for part in (relation.gains[:index], relation.gains[index:]))
    message = (
        f"the scale of the {name} changes by a factor of "
        f"{np.exp(size if relation.second == name else -size):.3g} at about {relation.times[index]:.0f} s: "
        f"{relation.label} is {before:.3g} before it and {after:.3g} after it; split the log there and identify from "
        "one part"
    )
    return [Finding("scale change", "error", log, message, *change_location(relation.times, index))]


def change_location(times: FloatArray, index: int) -> tuple[tuple[float, float], tuple[MappingChange, ...]]:
    """Return the time span [s] of a change at part `index`, and the proposed mapping change of `times`.

    Parts start at `times` (n,) [s]. The proposal selects the log before or after the change, whichever is longer,
    without the parts that may contain the change.
    """
    after = min(index + 1, len(times) - 1)
    end = float(2 * times[-1] - times[-2])
    sides = (float(times[0]), float(times[index - 1])), (float(times[after]), end)
    start, stop = max(sides, key=lambda span: span[1] - span[0])
    change = MappingChange("log", "times", f"{start:.1f} to {stop:.1f}")
    return (float(times[index - 1]), float(times[after])), (change,)


def _detect_change(values: FloatArray, significance: float) -> tuple[int, float, float] | None:
    """Detect a change of level in values (n,); return its index, size and threshold, or None for too few values.

    The threshold has the same tail probability in Student's t distribution as `significance` standard deviations in
    the normal distribution.
    """
    best: tuple[float, int, float, float] | None = None
    for index in range(2, len(values) - 1):
        left, right = values[:index], values[index:]
        squares = float(((left - left.mean()) ** 2).sum() + ((right - right.mean()) ** 2).sum())
        deviation = np.sqrt(squares / (len(values) - 2) * (1 / len(left) + 1 / len(right)))
        if best is None or squares < best[0]:
            best = (squares, index, float(right.mean() - left.mean()), float(deviation))
    if best is None:
        return None
    _, index, change, deviation = best
    return index, change, deviation * float(-special.stdtrit(len(values) - 2, special.ndtr(-significance)))


def compare(
    first: str,
    second: str,
    first_relations: Sequence[Relation],
    second_relations: Sequence[Relation],
    settings: CheckSettings,
) -> list[Finding]:
    """Return at most one finding: gains or delays of two logs are inconsistent with one robot."""
    for a in first_relations:
        pair = a.first, a.second, a.channel
        b = next((b for b in second_relations if (b.first, b.second, b.channel) == pair), None)
        if b is None or POSE in (a.first, a.second):
            continue
        log_gains = np.log(a.gains), np.log(b.gains)
        difference = float(log_gains[1].mean() - log_gains[0].mean())
        deviation = float(np.hypot(*(part.std() / np.sqrt(len(part)) for part in log_gains)))
        delay = abs(a.response - b.response)
        gain_differs = abs(difference) > max(np.log(settings.gain_tolerance), settings.significance * deviation)
        if not gain_differs and not delay > settings.response_tolerance:
            continue
        means = [float(np.exp(part.mean())) for part in log_gains]
        message = (
            f"{a.label} is {means[0]:.3g} in {first} and {means[1]:.3g} in {second}"
            if gain_differs
            else f"{CHANNELS[a.channel]} follows after {a.response:.2f} s in {first} and {b.response:.2f} s in {second}"
        )
        message += ": check for different robots, loads or mappings, or identify each log separately"
        return [Finding("different logs", "warning", f"{first}, {second}", message)]
    return []
