"""Second publisher on a topic, by the publication numbers of its messages."""

from __future__ import annotations

from collections import deque

_FALLS = 3
_MESSAGES, _TIME = 6, 0.3
"""The numbers of two publishers decrease three times within this number of messages, or this time [s]."""


class Senders:
    """Detect two publishers that both send on a topic.

    Each publisher numbers its messages. The numbers of one publisher fall once if it is started again; those of two
    publishers fall again and again.
    """

    def __init__(self) -> None:
        self._last = self._count = 0
        self._falls: deque[tuple[int, float]] = deque(maxlen=_FALLS)

    def take(self, number: int | None, now: float) -> bool:
        """Take in the number of a message that arrives at `now` [s]; None if the middleware has no numbers.

        Returns whether two publishers send.
        """
        if not number:
            return False
        falls, self._last = number <= self._last, number
        self._count += 1
        if not falls:
            return False
        self._falls.append((self._count, now))
        count, time = self._falls[0]
        return len(self._falls) == _FALLS and (self._count - count <= _MESSAGES or now - time <= _TIME)
