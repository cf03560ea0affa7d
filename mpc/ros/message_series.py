"""Series of messages on one topic: detect if two publishers are alive at the same time."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

_DEPTH = 3
"""Maximum number of messages that may overtake a message."""
_LIFETIME, _LIFETIME_PERIODS, _MAX_LIFETIME = 0.3, 4.0, 5.0
"""Time without a message after which a series has ended: minimum [s], in periods of the series, and maximum [s]."""
_MAX_CHANGES = 6
"""Number of stored changes from one series to another."""
_REPETITIONS = 4
"""Number of consecutive messages with the same number after which the numbers count as constant."""


@dataclass(eq=False)
class _Series:
    newest: int = 0
    arrival: float = 0.0
    recent: deque[tuple[int, int]] = field(default_factory=lambda: deque(maxlen=_DEPTH + 1))
    """Number and sending time of the last messages."""

    def fits(self, number: int, sent: int) -> bool:
        """Return True if the message can belong to this series: numbers must increase with the sending time."""
        return number > self.newest - _DEPTH and all(
            sent >= time if number > past else sent <= time and number < past for past, time in self.recent
        )

    def is_alive(self, arrival: float) -> bool:
        """Return True if the publisher of this series may still send at `arrival` [s]."""
        (first, start), (last, end) = min(self.recent), max(self.recent)
        period = 1e-9 * (end - start) / (last - first) if last > first else _MAX_LIFETIME
        return arrival - self.arrival <= min(max(_LIFETIME, _LIFETIME_PERIODS * period), _MAX_LIFETIME)

    def append(self, number: int, sent: int, arrival: float) -> None:
        self.newest, self.arrival = max(self.newest, number), arrival
        self.recent.append((number, sent))


class MessageSeries:
    """Detector of two live publishers on one topic.

    Each publisher numbers its messages in the order of sending. A message that cannot continue a known series starts a
    new series. A restarted publisher never continues its old series. With two live publishers both series continue, so
    each occurs at least twice among the last changes of series.

    Attributes
    ----------
    is_shared
        True once two live publishers were detected, until `restart`.
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
        self._changes: deque[_Series] = deque(maxlen=_MAX_CHANGES)

    def take(self, number: int | None, sent: int, arrival: float) -> None:
        """Record a message.

        Parameters
        ----------
        number
            Publication number; None or 0 if the middleware has none.
        sent
            Sending time by the clock of the publisher [ns].
        arrival
            Time of arrival by a monotonic clock [s].
        """
        self._repetitions = self._repetitions + 1 if number == self._last else 1
        self._last = number or 0
        self.is_numbered = bool(number) and self._repetitions < _REPETITIONS
        if not number or not self.is_numbered:
            return
        self._series = [series for series in self._series if series.is_alive(arrival)]
        fitting = [series for series in self._series if series.fits(number, sent)]
        # Of equally close series take the latest: the list is in the order of the last messages.
        series = min(reversed(fitting), key=lambda series: abs(number - series.newest), default=_Series())
        series.append(number, sent, arrival)
        self._series = [*(each for each in self._series if each is not series), series]
        if not self._changes or self._changes[-1] is not series:
            self._changes.append(series)
            self.is_shared = self.is_shared or sum(self._changes.count(each) > 1 for each in self._series) > 1
