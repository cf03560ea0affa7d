"""Whether the parts of a log, and several logs, are of one robot: their gains, and how late they answer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy import special

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.check_settings import CheckSettings
from diffdrive_mpc.models.logs.diagnosis.streams import COMMAND, POSE, Streams, answer, paired
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
    def what(self) -> str:
        """In words."""
        return f"{CHANNELS[self.channel]} of the {self.second} over that of the {self.first}"


def relations(streams: Streams, settings: CheckSettings) -> list[Relation]:
    """All pairs of streams that follow each other clearly."""
    pairs = []
    for channel in (0, 1):
        for first, second in combinations([COMMAND, *streams.present(channel)], 2):
            a, b = streams.pair(first, second, channel)
            how = answer(streams, a, b, settings, both_measured=first != COMMAND)
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
    """Gains of y over u in parts that were driven equally hard, and when these begin [s]."""
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
        # A part in which the stream hardly changes tells of no gain.
        if len(part) > 2 and np.var(u[part]) > settings.least_part_change * np.var(u):
            slope = np.cov(u[part], y[part])[0, 1] / np.var(u[part], ddof=1)
            if slope > 0:
                gains.append(slope)
                times.append(time[part[0]])
    return np.array(gains), np.array(times)


def check_parts(log: str, streams: Streams, settings: CheckSettings) -> list[Finding]:
    """At most one finding: a stream whose scale changes in the middle of the log."""
    changes: list[tuple[Relation, int, float]] = []
    steady: list[Relation] = []
    for relation in relations(streams, settings):
        change = _change(np.log(relation.gains), settings.certain)
        if change and abs(change[1]) > max(np.log(settings.scale_change), change[2]):
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
    # Of two that disagree the sensor is named: what a robot answers may change, what it was told does not.
    name = max(counts, key=lambda key: (counts[key], key != COMMAND))
    relation, at, size = max(
        (change for change in changes if name in (change[0].first, change[0].second)), key=lambda change: abs(change[2])
    )
    before, after = (float(np.exp(np.mean(np.log(part)))) for part in (relation.gains[:at], relation.gains[at:]))
    words = (
        f"the scale of the {name} changes by a factor of "
        f"{np.exp(size if relation.second == name else -size):.3g} at about {relation.times[at]:.0f} s: "
        f"{relation.what} is {before:.3g} before and {after:.3g} after; cut the log there and identify from one part"
    )
    # The change lies in one of the parts on either side of the place.
    begin, end = float(np.nanmin(streams.time)), float(np.nanmax(streams.time))
    last, first = float(relation.times[at - 1]), float(relation.times[min(at + 1, len(relation.times) - 1)])
    longer = (begin, last) if last - begin > end - first else (first, end)
    kept = MappingChange("log", "times", f"{longer[0]:.1f} to {longer[1]:.1f}")
    return [Finding("scale change", "error", log, words, changes=(kept,))]


def _change(values: FloatArray, certain: float) -> tuple[int, float, float] | None:
    """Where a row of values changes its level, by how much, and what would be chance; None where it is too short.

    Few values know their scatter badly: chance is as rare as `certain` standard deviations of a known one (Student).
    """
    best: tuple[float, int, float, float] | None = None
    for at in range(2, len(values) - 1):
        left, right = values[:at], values[at:]
        inside = float(((left - left.mean()) ** 2).sum() + ((right - right.mean()) ** 2).sum())
        deviation = np.sqrt(inside / (len(values) - 2) * (1 / len(left) + 1 / len(right)))
        if best is None or inside < best[0]:
            best = (inside, at, float(right.mean() - left.mean()), float(deviation))
    if best is None:
        return None
    _, at, change, deviation = best
    return at, change, deviation * float(-special.stdtrit(len(values) - 2, special.ndtr(-certain)))


def compare(
    first: str, second: str, one: Sequence[Relation], other: Sequence[Relation], settings: CheckSettings
) -> list[Finding]:
    """At most one finding: gains or answers of two logs that no drive of one robot explains."""
    for a in one:
        b = next((b for b in other if (b.first, b.second, b.channel) == (a.first, a.second, a.channel)), None)
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
            f"{a.what} is {means[0]:.3g} in {first} and {means[1]:.3g} in {second}"
            if gain
            else f"{CHANNELS[a.channel]} answers after {a.response:.2f} s in {first} and {b.response:.2f} s in {second}"
        )
        words += ": two robots, loads or mappings? Identify each by itself"
        return [Finding("different logs", "warning", f"{first}, {second}", words)]
    return []
