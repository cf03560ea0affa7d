"""Detection of disturbed timings by counters; processes of peers import it, so it needs only the standard library.

Work is undisturbed if its thread was never preempted and occupied the processor without interruption, and if the
computer ran at full speed before and after the work. The speed is measured by a yardstick, a fixed computation whose
duration increases if the processor is throttled or shares its core with another virtual machine, which the operating
system cannot detect.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple, TypeVar

try:
    import resource
except ImportError:  # without this module, context switches are not counted
    resource = None  # type: ignore[assignment]

T = TypeVar("T")

IDLE_TOLERANCE = (2e-5, 0.01)
"""Tolerated time without the processor: constant part [s] and share of the elapsed time [-].

A small difference is normal, because the clocks are read one after the other.
"""
SLOW_RATIO = 1.15
"""Ratio of the yardstick's time to its minimum above which the computer counts as slow."""
_PROBES, _SUMMANDS = 3, 300


class Effort(NamedTuple):
    """Cost of some work: elapsed and processor time [s], involuntary context switches, time of the yardstick [s]."""

    elapsed: float
    processor: float
    switches: int
    pace: float

    def is_undisturbed(self, best_pace: float) -> bool:
        """Return True if the work was undisturbed; `best_pace` is the minimum time of the yardstick [s]."""
        away = self.elapsed - self.processor
        return (
            self.switches == 0
            and away <= IDLE_TOLERANCE[0] + IDLE_TOLERANCE[1] * self.elapsed
            and self.pace <= SLOW_RATIO * best_pace
        )


def measure_effort(work: Callable[[], T]) -> tuple[T, Effort]:
    """Run `work`; return its result and its effort. The yardstick is measured before and after the work."""
    pace = yardstick()
    start, processor, switches = time.perf_counter(), time.thread_time(), _switches()
    result = work()
    effort = (time.perf_counter() - start, time.thread_time() - processor, _switches() - switches)
    return result, Effort(*effort, max(pace, yardstick()))


def yardstick() -> float:
    """Return the minimum time of a few runs of a fixed sum [s]; the call takes a few dozen microseconds."""
    return min(_one_sum() for _ in range(_PROBES))


def _one_sum() -> float:
    start = time.perf_counter()
    total = 0
    for i in range(_SUMMANDS):
        total += i * i
    return time.perf_counter() - start


def _switches() -> int:
    if resource is None:
        return 0
    return resource.getrusage(getattr(resource, "RUSAGE_THREAD", resource.RUSAGE_SELF)).ru_nivcsw


def busy_time(core: int | None) -> float:
    """Return the busy time of a core since the system started [s]; 0 if unknown."""
    try:
        lines = Path("/proc/stat").read_text(encoding="ascii").splitlines()
    except OSError:
        return 0.0
    # user, nice, system, idle, iowait, irq, softirq
    ticks = next(([int(word) for word in line.split()[1:8]] for line in lines if line.startswith(f"cpu{core} ")), None)
    return 0.0 if ticks is None else (sum(ticks[:3]) + sum(ticks[5:])) / os.sysconf("SC_CLK_TCK")
