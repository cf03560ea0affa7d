"""Percentiles of the durations and latencies of the last ticks."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

_MIN_TICKS = 20
"""Minimum number of ticks for an evaluation of the period."""
_MAX_DEVIATION = 0.1
"""Maximum relative deviation of the median tick interval from the period [-]."""


@dataclass(frozen=True, slots=True)
class Percentiles:
    """Median, 99th percentile and maximum [s], and number of values; NaN if there are no values."""

    p50: float
    p99: float
    max: float
    count: int


class Durations:
    """Window of the last durations of one kind.

    Parameters
    ----------
    window
        Number of stored durations.
    """

    def __init__(self, window: int) -> None:
        self._values: deque[float] = deque(maxlen=window)

    def add(self, value: float) -> None:
        """Append a duration [s]."""
        self._values.append(value)

    def percentiles(self) -> Percentiles:
        """Compute the percentiles of the stored values."""
        if not self._values:
            return Percentiles(np.nan, np.nan, np.nan, 0)
        p50, p99, maximum = np.percentile(self._values, [50, 99, 100]).tolist()
        return Percentiles(p50, p99, maximum, len(self._values))


class LoopTimes:
    """Statistics of the durations of the control loop.

    Parameters
    ----------
    period
        Nominal tick period [s].
    window
        Number of stored ticks.

    Attributes
    ----------
    step
        Duration of one tick [s].
    jitter
        Absolute deviation of the time between two ticks from the period [s].
    latency
        Time from the stamp of the newest odometry to the command that uses it [s].
    misses
        Number of ticks that took longer than the period, plus number of ticks that started half a period late.
    """

    def __init__(self, period: float, window: int) -> None:
        self._period = period
        self.step, self.jitter, self.latency = Durations(window), Durations(window), Durations(window)
        self.misses = 0
        self._last_start: float | None = None

    def start_tick(self, now: float) -> None:
        """Record the start of a tick at `now` [s]."""
        if self._last_start is not None:
            gap = now - self._last_start
            self.jitter.add(abs(gap - self._period))
            self.misses += gap > 1.5 * self._period
        self._last_start = now

    @property
    def is_off_period(self) -> bool:
        """True if the median tick interval differs from the period."""
        jitter = self.jitter.percentiles()
        return jitter.count >= _MIN_TICKS and jitter.p50 > _MAX_DEVIATION * self._period

    def end(self, duration: float, latency: float | None) -> None:
        """Record the `duration` of a tick [s], and its `latency` [s] if odometry has arrived."""
        self.step.add(duration)
        self.misses += duration > self._period
        if latency is not None:
            self.latency.add(latency)
