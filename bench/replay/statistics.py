"""What a replay is measured by: differences of commands, shares, ages and innovations."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from diffdrive_mpc.bench.replay.open_loop import Replayed
from diffdrive_mpc.bench.replay.recording import Recording
from diffdrive_mpc.bench.replay.settings import replay_settings
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.record import BoolArray
from diffdrive_mpc.mpc.estimation.estimate import SENSORS


@dataclass(frozen=True)
class Difference:
    """Of two rows of n commands.

    Attributes
    ----------
    compared
        Ticks at which both are known.
    differing
        How many of them differ by more than rounding.
    rms, largest
        (2,) of v [m/s] and omega [rad/s].
    largest_at
        (2,) when [s].
    first
        When they differ first [s]; NaN where they never do.
    """

    compared: int
    differing: int
    rms: FloatArray
    largest: FloatArray
    largest_at: FloatArray
    first: float

    @property
    def same(self) -> bool:
        """Whether there is nothing but rounding between them."""
        return self.compared > 0 and not self.differing


def difference(time: FloatArray, one: FloatArray, other: FloatArray, counted: BoolArray) -> Difference:
    """Of commands (n, 2) at `time` (n,) [s], over the ticks that are `counted` (n,)."""
    known = counted & np.isfinite(one).all(axis=1) & np.isfinite(other).all(axis=1)
    apart, time = np.abs(one - other)[known], time[known]
    if not len(apart):
        return Difference(0, 0, *np.full((3, 2), np.nan), np.nan)
    differing = (apart > replay_settings().exact).any(axis=1)
    first = float(time[np.argmax(differing)]) if differing.any() else np.nan
    at = time[np.argmax(apart, axis=0)]
    rms = np.sqrt(np.mean(apart**2, axis=0))
    return Difference(len(apart), int(differing.sum()), rms, apart.max(axis=0), at, first)


def shares(words: Sequence[str], counted: BoolArray) -> dict[str, float]:
    """Share [%] of each word in the counted ticks."""
    chosen = [word for word, keep in zip(words, counted, strict=True) if keep]
    return {word: 100.0 * count / len(chosen) for word, count in Counter(chosen).most_common() if word}


@dataclass(frozen=True)
class SensorRow:
    """One sensor in the counted ticks.

    Attributes
    ----------
    name
        Of the sensor.
    readings
        How many came.
    interval, longest_gap, gap_at
        Median time between ticks that brought one, the longest, and when it began [s].
    age_p50, age_p99
        From the stamp to the tick that got it [s].
    innovations, innovation
        How many innovations there are, and their mean square over their variance, by the filter's sensors of it.
    """

    name: str
    readings: int
    interval: float
    longest_gap: float
    gap_at: float
    age_p50: float
    age_p99: float
    innovations: tuple[tuple[str, int, float], ...]


_INNOVATIONS = {"pose": (3,), "wheel_twist": (0, 1), "yaw_rate": (2,)}
NAMES = {"pose": "poses", "wheel_twist": "wheels", "yaw_rate": "gyro"}


def sensor_rows(recording: Recording, replayed: Replayed, counted: BoolArray) -> tuple[SensorRow, ...]:
    """A row for each sensor that delivered something, poses always."""
    rows = []
    for field, name in NAMES.items():
        came = [
            (tick.time, getattr(tick.measurement, field).time)
            for tick, keep in zip(recording.ticks, counted, strict=True)
            if keep and getattr(tick.measurement, field) is not None
        ]
        if not came and field != "pose":
            continue
        rows.append(_row(name, np.array(came).reshape(-1, 2), _innovations(field, replayed, counted)))
    return tuple(rows)


def _row(name: str, came: FloatArray, innovations: tuple[tuple[str, int, float], ...]) -> SensorRow:
    gaps, age = np.diff(came[:, 0]), came[:, 0] - came[:, 1]
    if not len(gaps):
        return SensorRow(name, len(came), *np.full(5, np.nan).tolist(), innovations)
    worst = int(np.argmax(gaps))
    interval, p50, p99 = float(np.median(gaps)), *np.percentile(age, [50, 99]).tolist()
    return SensorRow(name, len(came), interval, float(gaps[worst]), float(came[worst, 0]), p50, p99, innovations)


def _innovations(field: str, replayed: Replayed, counted: BoolArray) -> tuple[tuple[str, int, float], ...]:
    found = []
    for column in _INNOVATIONS[field]:
        values = replayed.innovations[counted, column]
        values = values[np.isfinite(values)]
        found.append((SENSORS[column], len(values), float(values.mean()) if len(values) else np.nan))
    return tuple(found)


def at_limits(command: FloatArray, before: FloatArray, replayed: Replayed) -> dict[str, tuple[float, float]]:
    """Share [%] of commands (n, 2), each after `before` (n, 2), at each limit, and beyond it.

    A command at rest that stays there is at none.
    """
    limits, beyond = replayed.config.limits, replay_settings().beyond_limit
    dt = replayed.config.sample_time
    found = {}
    for column, name in enumerate(("v", "omega")):
        for what, value, limit in (
            (name, np.abs(command[:, column]), getattr(limits, name)),
            (f"{name}_slew", np.abs(command[:, column] - before[:, column]) / dt, getattr(limits, f"{name}_slew")),
        ):
            known = np.isfinite(value)
            if known.any():
                at = 100.0 * np.mean(value[known] >= limit * (1 - 1e-6))
                over = 100.0 * np.mean(value[known] > limit * (1 + 1e-6) + beyond)
                found[what] = (float(at), float(over))
    return found
