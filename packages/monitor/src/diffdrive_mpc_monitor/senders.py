"""Second publisher on a topic, by the publication numbers of its messages."""

from __future__ import annotations

_MESSAGES, _TIME = 8, 0.5
"""Numbers that fall again after so few messages, or so little time [s], are those of two publishers."""


class Senders:
    """Detect two publishers that both send on a topic.

    Each publisher numbers its messages. The numbers of one publisher fall once if it is started again; those of two
    publishers fall again and again.
    """

    def __init__(self) -> None:
        self._last, self._fall_at, self._since_fall = 0, float("-inf"), _MESSAGES

    def take(self, number: int | None, now: float) -> bool:
        """Take in the number of a message that arrives at `now` [s]; None if the middleware has no numbers.

        Returns whether two publishers send.
        """
        if not number:
            return False
        falls, self._last = number <= self._last, number
        self._since_fall += 1
        if not falls:
            return False
        is_shared = self._since_fall <= _MESSAGES or now - self._fall_at <= _TIME
        self._since_fall, self._fall_at = 0, now
        return is_shared
