"""Checks of the times of controller calls."""

from __future__ import annotations

import math
from enum import Enum, auto


class TickKind(Enum):
    """Kind of a call of the controller."""

    NEW = auto()
    """The next tick, possibly after missed ticks."""
    REPEATED = auto()
    """Less than half a sample after the last tick: too soon for a new command."""
    LEAPT = auto()
    """Long after the last tick: a pause or a clock fault, to be decided at the next tick."""
    PAUSED = auto()
    """A pause after which the estimate is lost."""
    FAULTY = auto()
    """An unusable time."""


class TickClock:
    """Classifier of the times of calls; the estimator can bridge pauses of up to `max_pause` [s]."""

    def __init__(self, dt: float, max_pause: float) -> None:
        self.dt, self.max_pause = dt, max_pause
        self.restart()

    def restart(self) -> None:
        """Reset: the next tick counts as the first tick."""
        self.last: float | None = None
        self.leap: float | None = None

    def judge(self, t: float) -> tuple[TickKind, str]:
        """Return the kind of the call at `t` [s], and a message if it is faulty."""
        leap, self.leap = self.leap, None
        if not math.isfinite(t):
            return TickKind.FAULTY, f"the time of this tick is {t}; it was not used"
        gap = self.dt if self.last is None else t - self.last
        if gap < 0:
            return TickKind.FAULTY, f"time ran backwards by {-gap:.3f} s; call start again if the clock was set"
        if gap < 0.5 * self.dt:
            return TickKind.REPEATED, f"called {1e3 * gap:.1f} ms after the last tick; its command is repeated"
        if gap > self.max_pause:
            # One leap may be a clock fault; a second tick shortly afterwards confirms a real pause.
            if leap is None or not 0 < t - leap <= self.max_pause:
                self.leap = t
                return TickKind.LEAPT, f"no tick for {gap:.2f} s"
            self.last = t
            return TickKind.PAUSED, f"no tick for {gap:.2f} s; the estimate restarts"
        self.last = t
        return TickKind.NEW, ""
