"""Series of messages on one topic: one living publisher, or two at the same time."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

_DEPTH = 3
"""Largest number of messages that may overtake a message."""
_LIFETIME, _LIFETIME_PERIODS, _MAX_LIFETIME = 0.3, 4.0, 5.0
"""Time without a message after which a series has ended: at least [s], in its periods, and at most [s]."""
_TURNS = 6
"""Number of changes from one series to another that are remembered."""
_REPETITIONS = 4
"""Number of consecutive messages with one number after which the numbers count as constant."""


@dataclass(eq=False)
class _Series:
    newest: int = 0
    arrival: float = 0.0
    recent: deque[tuple[int, int]] = field(default_factory=lambda: deque(maxlen=_DEPTH + 1))
    """Number and time of sending of the last messages."""

    def fits(self, number: int, sent: int) -> bool:
        """Return True if the publisher of this series can have sent the message: its numbers rise with the time."""
        return number > self.newest - _DEPTH and all(
            sent >= time if number > past else sent <= time and number < past for past, time in self.recent
        )

    def lives(self, arrival: float) -> bool:
        """Return True if its publisher may still send at `arrival` [s]."""
        (first, began), (last, ended) = min(self.recent), max(self.recent)
        period = 1e-9 * (ended - began) / (last - first) if last > first else _MAX_LIFETIME
        return arrival - self.arrival <= min(max(_LIFETIME, _LIFETIME_PERIODS * period), _MAX_LIFETIME)

    def append(self, number: int, sent: int, arrival: float) -> None:
        self.newest, self.arrival = max(self.newest, number), arrival
        self.recent.append((number, sent))


class MessageSeries:
    """Detect that the messages of a topic come from two living publishers.

    Each publisher numbers its messages in the order of sending. A message that cannot continue a known series begins
    another one. A restarted publisher leaves its old series behind for good. With two living publishers both series go
    on: each of them has two of the last turns.

    Attributes
    ----------
    is_shared
        True once two living publishers were detected, until `restart`.
    is_numbered
        False if the middleware does not number messages; two publishers are then not detected.
    """

    def __init__(self) -> None:
        self.is_numbered = True
        self._last, self._repetitions = 0, 0
        self.restart()

    def restart(self) -> None:
        """Discard all messages."""
        self.is_shared = False
        self._series: list[_Series] = []
        self._turns: deque[_Series] = deque(maxlen=_TURNS)

    def take(self, number: int | None, sent: int, arrival: float) -> None:
        """Take in a message.

        Parameters
        ----------
        number
            Publication number; None or 0 if the middleware has none.
        sent
            Time of sending by the clock of the publisher [ns].
        arrival
            Time of a monotonic clock [s].
        """
        self._repetitions = self._repetitions + 1 if number == self._last else 1
        self._last = number or 0
        self.is_numbered = bool(number) and self._repetitions < _REPETITIONS
        if not number or not self.is_numbered:
            return
        self._series = [series for series in self._series if series.lives(arrival)]
        fitting = [series for series in self._series if series.fits(number, sent)]
        # The last of equally close ones: the list is in the order of their last messages.
        series = min(reversed(fitting), key=lambda series: abs(number - series.newest), default=_Series())
        series.append(number, sent, arrival)
        self._series = [*(each for each in self._series if each is not series), series]
        if not self._turns or self._turns[-1] is not series:
            self._turns.append(series)
            self.is_shared = self.is_shared or sum(self._turns.count(each) > 1 for each in self._series) > 1
