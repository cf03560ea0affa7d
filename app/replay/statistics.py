"""What a replay is measured by: differences of commands, shares, ages and innovations."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from diffdrive_mpc.app.replay.open_loop import Replayed
from diffdrive_mpc.app.replay.recording import Recording
from diffdrive_mpc.app.replay.settings import replay_settings
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
        unknown = np.full(2, np.nan)
        return Difference(0, 0, unknown, unknown, unknown, np.nan)
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
    innovations
        By the filter's sensors of it: how many innovations there are, and their usual square over its variance: its
        median over the median where the filter's assumptions hold, so that a few outliers do not count [-].
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
_MEDIANS = (*(float(chi2.median(1)),) * 3, float(chi2.median(3)) / 3)
"""Of squared innovations over their variance, where the filter's assumptions hold, by `SENSORS`."""
NAMES = {"pose": "poses", "wheel_twist": "wheels", "yaw_rate": "gyro"}


def sensor_rows(recording: Recording, replayed: Replayed, counted: BoolArray) -> tuple[SensorRow, ...]:
    """A row for each sensor that delivered something, poses always."""
    rows = []
    drives = np.cumsum([tick.start is not None for tick in recording.ticks])
    for field, name in NAMES.items():
        came = [
            (tick.time, getattr(tick.measurement, field).time, drive)
            for tick, drive, keep in zip(recording.ticks, drives, counted, strict=True)
            if keep and getattr(tick.measurement, field) is not None
        ]
        if not came and field != "pose":
            continue
        rows.append(_row(name, np.array(came).reshape(-1, 3), _innovations(field, replayed, counted)))
    return tuple(rows)


def _row(name: str, came: FloatArray, innovations: tuple[tuple[str, int, float], ...]) -> SensorRow:
    """Of readings with time, stamp and the number of their drive (m, 3); between two drives there is no gap."""
    gaps, age = np.diff(came[:, 0]), came[:, 0] - came[:, 1]
    gaps = np.where(np.diff(came[:, 2]) == 0, gaps, 0.0)
    if not len(gaps):
        return SensorRow(name, len(came), np.nan, np.nan, np.nan, np.nan, np.nan, innovations)
    worst = int(np.argmax(gaps))
    interval = float(np.median(gaps))
    p50, p99 = np.percentile(age, [50, 99]).tolist()
    return SensorRow(name, len(came), interval, float(gaps[worst]), float(came[worst, 0]), p50, p99, innovations)


def _innovations(field: str, replayed: Replayed, counted: BoolArray) -> tuple[tuple[str, int, float], ...]:
    statistics = []
    for column in _INNOVATIONS[field]:
        values = replayed.innovations[counted, column]
        values = values[np.isfinite(values)]
        usual = float(np.median(values)) / _MEDIANS[column] if len(values) else np.nan
        statistics.append((SENSORS[column], len(values), usual))
    return tuple(statistics)


def at_limits(command: FloatArray, before: FloatArray, replayed: Replayed) -> dict[str, tuple[float, float]]:
    """Share [%] of commands (n, 2), each after `before` (n, 2), at each limit, and beyond it.

    A command at rest that stays there is at none.
    """
    limits, beyond = replayed.config.limits, replay_settings().beyond_limit
    dt = replayed.config.sample_time
    counts = {}
    for column, name in enumerate(("v", "omega")):
        for what, value, limit in (
            (name, np.abs(command[:, column]), getattr(limits, name)),
            (f"{name}_slew", np.abs(command[:, column] - before[:, column]) / dt, getattr(limits, f"{name}_slew")),
        ):
            known = np.isfinite(value)
            if known.any():
                at = 100.0 * np.mean(value[known] >= limit * (1 - 1e-6))
                over = 100.0 * np.mean(value[known] > limit * (1 + 1e-6) + beyond)
                counts[what] = (float(at), float(over))
    return counts
