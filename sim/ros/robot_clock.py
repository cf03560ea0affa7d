"""The two clocks that a simulated base can live by."""

from __future__ import annotations

import time


class SteppedClock:
    """Time that passes in samples, as published on /clock.

    Attributes
    ----------
    origin
        The plant's time 0 [ns].

    Parameters
    ----------
    first_tick
        Samples on the clock at the plant's time 0.
    sample_time
        [s].
    """

    def __init__(self, first_tick: int, sample_time: float) -> None:
        self._sample = sample_time
        # A whole number of samples: a node's timer, which counts from 0, then falls due on the ticks.
        self.origin = round(1e9 * first_tick * sample_time)
        self._now = self.origin

    def __call__(self) -> int:
        """Time of the current tick [ns]."""
        return self._now

    def at(self, tick: int) -> int:
        """Go to the instant of a tick, which may lie before the first one, and return it [ns]."""
        self._now = self.origin + round(1e9 * tick * self._sample)
        return self._now


class WallClock:
    """The system's time at the start, carried on by the steady clock: it never jumps.

    Attributes
    ----------
    origin
        The plant's time 0 [ns]; moves on when lost time is given up.
    """

    def __init__(self) -> None:
        self._offset = time.time_ns() - time.monotonic_ns()
        self.origin = self()

    def __call__(self) -> int:
        """Now [ns]."""
        return time.monotonic_ns() + self._offset
