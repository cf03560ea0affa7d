"""Times of the calls of the controller, and their faults."""

from __future__ import annotations

import math
from enum import Enum, auto


class TickKind(Enum):
    """Kind of a call of the controller."""

    NEW = auto()
    """The next tick, perhaps after missed ones."""
    REPEATED = auto()
    """Less than half a sample after the last tick: too soon for a new command."""
    LEAPT = auto()
    """Long after the last tick: a pause, or a glitch of the clock; the next tick decides."""
    PAUSED = auto()
    """A pause after which the estimate is lost."""
    FAULTY = auto()
    """A time that cannot be used."""


class TickClock:
    """Classifies the time of each call; a pause of up to `max_pause` [s] can be bridged."""

    def __init__(self, dt: float, max_pause: float) -> None:
        self.dt, self.max_pause = dt, max_pause
        self.restart()

    def restart(self) -> None:
        """Take the next tick as the first."""
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
            # One leap may be a glitch of the clock; a second tick right after it shows a real pause.
            if leap is None or not 0 < t - leap <= self.max_pause:
                self.leap = t
                return TickKind.LEAPT, f"no tick for {gap:.2f} s"
            self.last = t
            return TickKind.PAUSED, f"no tick for {gap:.2f} s; the estimate restarts"
        self.last = t
        return TickKind.NEW, ""
