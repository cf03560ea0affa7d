"""Watch of one incoming topic: age of its last good message, and reasons for rejected messages.

Reactions of the node to a fault are in `ControlLoop` (`control_loop.py`), and in words in docs/safety.md.
"""

from __future__ import annotations

import math

from diffdrive_mpc.mpc.ros.conversions import MessageError
from diffdrive_mpc.mpc.ros.message_series import MessageSeries


class TopicWatch:
    """State of one topic.

    Parameters
    ----------
    name
        Name of the topic, for people.

    Attributes
    ----------
    accepted, refused
        Number of accepted and of refused messages.
    reason
        Why the last message was refused; empty once a good one came.
    last_refusal
        The same, kept for diagnostics.
    source
        Content of the topic and its publisher, in words, for a topic on which nothing has arrived yet.
    delay
        From the stamp of the last good message to its arrival [s]; NaN before the first.
    series
        Publication numbers of all messages, refused ones included.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self.accepted = self.refused = 0
        self.reason = self.last_refusal = self.source = ""
        self.delay = math.nan
        self.series = MessageSeries()
        self.restart()

    def restart(self) -> None:
        """Discard the stamps: the next message is the first."""
        self._stamp: float | None = None

    def accept(self, stamp: float, now: float, ahead: float) -> None:
        """Take in a good message with `stamp` [s], arrived at `now` [s].

        Raises
        ------
        MessageError
            If its stamp is more than `ahead` [s] in the future, or not newer than that of the last. A refused stamp is
            not remembered: the next good message counts.
        """
        if stamp - now > ahead:
            raise MessageError(f"its stamp is {stamp - now:.3f} s in the future: are the clocks in step?")
        if self._stamp is not None and stamp <= self._stamp:
            raise MessageError(f"its stamp is {self._stamp - stamp:.3f} s before the last; reset if the clock was set")
        self._stamp, self.delay, self.reason = stamp, now - stamp, ""
        self.accepted += 1

    def take_back(self, stamp: float | None) -> None:
        """Undo the last `accept`: the message cannot be used after all, and the last good one has `stamp` [s]."""
        self._stamp = stamp
        self.accepted -= 1

    def refuse(self, reason: str) -> None:
        """Count a message that cannot be used, and why."""
        self.reason = self.last_refusal = f"{self.name} refused: {reason}"
        self.refused += 1

    def age(self, now: float) -> float:
        """Time since the stamp of the last good message [s]; infinite before the first."""
        return math.inf if self._stamp is None else now - self._stamp

    def fault(self, now: float, timeout: float) -> str:
        """Describe why the topic is unreliable at `now` [s]; return an empty string if it is reliable."""
        age = self.age(now)
        if -timeout <= age <= timeout:
            return ""
        late = f"{self.name} is {age:.2f} s old, the limit is {timeout:g} s"
        if math.isinf(age):
            late = f"no {self.name} yet" + (f" ({self.source})" if self.source else "")
        elif age < 0:
            late = f"{self.name} is {-age:.2f} s in the future: are the clocks in step?"
        return f"{late}; {self.reason}" if self.reason else late
