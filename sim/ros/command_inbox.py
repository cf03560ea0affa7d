"""The commands that reached the base: which one holds, and whether it answers a tick."""

from __future__ import annotations

import math

STOP = (0.0, 0.0)


class CommandInbox:
    """Keeps the newest sound command and lets it lapse.

    Times are whole nanoseconds on the robot's clock.

    Parameters
    ----------
    timeout
        How long a command holds after its receipt [ns]; as old may its stamp be.
    tolerance
        How far the stamp of an answer may be from its tick [ns].
    """

    def __init__(self, timeout: int, tolerance: int) -> None:
        self._timeout, self._tolerance = timeout, tolerance
        self._command = STOP
        self._received: int | None = None
        self._stamp = 0

    def put(self, v: float, omega: float, stamp: int, now: int) -> str:
        """Take in a command v [m/s], omega [rad/s] that arrives at `now`.

        Parameters
        ----------
        stamp
            Of its header; 0 where it has none or nobody set it.

        Returns
        -------
        str
            Why the command was refused, in one sentence; empty where it was not.
        """
        if not (math.isfinite(v) and math.isfinite(omega)):
            return f"command v = {v}, omega = {omega} is not finite; it is ignored"
        if stamp and abs(now - stamp) > self._timeout:
            age = f"{1e-9 * abs(now - stamp):.3f} s {'old' if stamp < now else 'ahead'}"
            return f"the stamp of the command is {age}; it is ignored: has the sender the same clock (use_sim_time)?"
        self._command, self._stamp, self._received = (v, omega), stamp, now
        return ""

    def command(self, now: int) -> tuple[float, float]:
        """The command that holds at `now`: v [m/s], omega [rad/s]; zero once the last one has lapsed."""
        return STOP if self.lapsed(now) or self._received is None else self._command

    def lapsed(self, now: int) -> bool:
        """Whether a command had been received, and none has come for longer than the timeout."""
        return self._received is not None and now - self._received > self._timeout

    def answers(self, tick: int) -> bool:
        """Whether the newest command belongs to the tick at this time: by its stamp, else by when it was received."""
        if self._received is None:
            return False
        return abs((self._stamp or self._received) - tick) <= self._tolerance
