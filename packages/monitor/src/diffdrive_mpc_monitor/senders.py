"""Detection of a second publisher on a topic by the publication numbers of messages."""

from __future__ import annotations

from collections import deque

_DECREASES = 3
_MAX_MESSAGES, _MAX_TIME = 6, 0.3
"""Number of messages and time [s] within which the numbers of two publishers decrease three times."""


class Senders:
    """Detect two publishers that both send on a topic.

    Each publisher numbers its messages. The numbers of a single publisher decrease only when it restarts, those of two
    publishers decrease repeatedly.
    """

    def __init__(self) -> None:
        self._last = self._count = 0
        self._decreases: deque[tuple[int, float]] = deque(maxlen=_DECREASES)

    def take(self, number: int | None, now: float) -> bool:
        """Add the number of a message that arrives at `now` [s]; None if the middleware has no numbers.

        Returns True if two publishers send.
        """
        if not number:
            return False
        decreased, self._last = number <= self._last, number
        self._count += 1
        if not decreased:
            return False
        self._decreases.append((self._count, now))
        count, time = self._decreases[0]
        return len(self._decreases) == _DECREASES and (self._count - count <= _MAX_MESSAGES or now - time <= _MAX_TIME)
