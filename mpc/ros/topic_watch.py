"""Monitoring of an input topic: age of the last valid message, and reasons for rejected messages.

The reactions of the node to a fault are in `ControlLoop` (`control_loop.py`) and documented in docs/safety.md.
"""

from __future__ import annotations

import math

from diffdrive_mpc.mpc.ros.conversions import MessageError
from diffdrive_mpc.mpc.ros.message_series import MessageSeries


class TopicWatch:
    """State of an input topic.

    Parameters
    ----------
    name
        Name of the topic in messages to the user.

    Attributes
    ----------
    accepted, refused
        Numbers of accepted and refused messages.
    reason
        Reason for the refusal of the last message; empty if the message was accepted.
    last_refusal
        Reason of the last refusal, also after later accepted messages, for diagnostics.
    source
        Description of the topic and its publishers; empty after the first message.
    delay
        Time from the stamp of the last valid message to its arrival [s]; NaN before the first valid message.
    series
        Series of all messages, including refused messages.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self.accepted = self.refused = 0
        self.reason = self.last_refusal = self.source = ""
        self.delay = math.nan
        self.series = MessageSeries()
        self.restart()

    def restart(self) -> None:
        """Discard the stamp of the last message; the next message counts as the first message."""
        self._stamp: float | None = None

    def accept(self, stamp: float, now: float, ahead: float) -> None:
        """Accept a valid message with `stamp` [s] that arrived at `now` [s].

        Raises
        ------
        MessageError
            If the stamp is more than `ahead` [s] in the future, or not newer than the last accepted stamp. A refused
            stamp is not stored.
        """
        if stamp - now > ahead:
            raise MessageError(f"its stamp is {stamp - now:.3f} s in the future: are the clocks in step?")
        if self._stamp is not None and stamp <= self._stamp:
            raise MessageError(f"its stamp is {self._stamp - stamp:.3f} s before the last; reset if the clock was set")
        self._stamp, self.delay, self.reason = stamp, now - stamp, ""
        self.accepted += 1

    def undo_accept(self, stamp: float | None) -> None:
        """Undo the last `accept` for an invalid message; `stamp` [s] is the stamp of the last valid message."""
        self._stamp = stamp
        self.accepted -= 1

    def refuse(self, reason: str) -> None:
        """Count an invalid message and store the reason."""
        self.reason = self.last_refusal = f"{self.name} refused: {reason}"
        self.refused += 1

    def age(self, now: float) -> float:
        """Return the time since the stamp of the last valid message [s]; infinite before the first valid message."""
        return math.inf if self._stamp is None else now - self._stamp

    def fault(self, now: float, timeout: float) -> str:
        """Return the reason why the topic is unreliable at `now` [s]; empty if it is reliable."""
        age = self.age(now)
        if -timeout <= age <= timeout:
            return ""
        fault = f"{self.name} is {age:.2f} s old, the limit is {timeout:g} s"
        if math.isinf(age):
            fault = f"no {self.name} yet" + (f" ({self.source})" if self.source else "")
        elif age < 0:
            fault = f"{self.name} is {-age:.2f} s in the future: are the clocks in step?"
        return f"{fault}; {self.reason}" if self.reason else fault
