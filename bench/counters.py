"""Detect by counters whether a timed run was disturbed. Standard library only: the processes of peers use it, too.

A short stretch of work is undisturbed if its thread was never preempted, had the processor all the time, and the
machine was as fast before and after it as at its best. The last is measured by a yardstick, a fixed bit of arithmetic:
a processor that is throttled, or shares its core with a neighbour that the system does not show, is slower at it.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple, TypeVar

try:
    import resource
except ImportError:  # a system without it counts no switches
    resource = None  # type: ignore[assignment]

T = TypeVar("T")

AWAY = (2e-5, 0.01)
"""Tolerated time without the processor [s] and share of the elapsed time [-]: the clocks are read in turn."""
SLOWER = 1.15
"""The machine counts as slow if the yardstick exceeds its best time by this factor."""
_PROBES, _SUMMANDS = 3, 300


class Effort(NamedTuple):
    """Cost of some work: elapsed and own processor time [s], involuntary switches, time of the yardstick [s]."""

    elapsed: float
    processor: float
    switches: int
    pace: float

    def undisturbed(self, best_pace: float) -> bool:
        """Return True if the work was undisturbed, for a machine whose yardstick takes `best_pace` [s] at its best."""
        away = self.elapsed - self.processor
        return self.switches == 0 and away <= AWAY[0] + AWAY[1] * self.elapsed and self.pace <= SLOWER * best_pace


def watched(work: Callable[[], T]) -> tuple[T, Effort]:
    """Run `work`; return its result and its effort. The yardstick is measured before and after."""
    pace = yardstick()
    began, processor, switches = time.perf_counter(), time.thread_time(), _switches()
    result = work()
    effort = (time.perf_counter() - began, time.thread_time() - processor, _switches() - switches)
    return result, Effort(*effort, max(pace, yardstick()))


def yardstick() -> float:
    """Time a fixed sum [s], the minimum of a few runs: a few dozen microseconds in all."""
    return min(_one_sum() for _ in range(_PROBES))


def _one_sum() -> float:
    began = time.perf_counter()
    total = 0
    for i in range(_SUMMANDS):
        total += i * i
    return time.perf_counter() - began


def _switches() -> int:
    if resource is None:
        return 0
    return resource.getrusage(getattr(resource, "RUSAGE_THREAD", resource.RUSAGE_SELF)).ru_nivcsw


def busy_time(core: int | None) -> float:
    """Return the time for which a core was busy since the system started [s]; 0 if unknown."""
    try:
        lines = Path("/proc/stat").read_text(encoding="ascii").splitlines()
    except OSError:
        return 0.0
    # user, nice, system, idle, iowait, irq, softirq
    ticks = next(([int(word) for word in line.split()[1:8]] for line in lines if line.startswith(f"cpu{core} ")), None)
    return 0.0 if ticks is None else (sum(ticks[:3]) + sum(ticks[5:])) / os.sysconf("SC_CLK_TCK")
