"""Detection of two live publishers on one topic by the publication numbers of their messages."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

_DEPTH = 3
"""Maximum number of later messages that may overtake a message."""
_LIFETIME, _LIFETIME_PERIODS, _MAX_LIFETIME = 0.3, 4.0, 5.0
"""Time without a message after which a series ends: minimum [s], in periods of the series [-], and maximum [s]."""
_MAX_CHANGES = 6
"""Number of stored changes from one series to another."""
_REPETITIONS = 4
"""Number of consecutive messages with equal numbers that shows that the middleware does not number messages."""


@dataclass(eq=False)
class _Series:
    """Messages of one publisher: highest number, time of the last arrival [s], and last messages."""

    newest: int = 0
    arrival: float = 0.0
    recent: deque[tuple[int, int]] = field(default_factory=lambda: deque(maxlen=_DEPTH + 1))
    """Numbers and sending times [ns] of the last messages."""

    def fits(self, number: int, sending_time: int) -> bool:
        """Return True if the message can belong to this series, whose numbers must increase with the sending time."""
        return number > self.newest - _DEPTH and all(
            sending_time >= time if number > recent else sending_time <= time and number < recent
            for recent, time in self.recent
        )

    def is_alive(self, arrival: float) -> bool:
        """Return True if the series has not ended at the time `arrival` [s]."""
        (first, start), (last, end) = min(self.recent), max(self.recent)
        period = 1e-9 * (end - start) / (last - first) if last > first else _MAX_LIFETIME
        return arrival - self.arrival <= min(max(_LIFETIME, _LIFETIME_PERIODS * period), _MAX_LIFETIME)

    def append(self, number: int, sending_time: int, arrival: float) -> None:
        self.newest, self.arrival = max(self.newest, number), arrival
        self.recent.append((number, sending_time))


class MessageSeries:
    """Detector of two live publishers on one topic.

    Each publisher numbers its messages in the order of sending. A message that does not fit a known series starts a new
    series, for instance the first message of a restarted publisher. With two live publishers, two series alternate, so
    both occur at least twice among the last changes from one series to another.

    Attributes
    ----------
    is_shared
        True from the detection of two live publishers until `restart`.
    is_numbered
        False if the middleware does not number messages; two publishers then cannot be detected.
    """

    def __init__(self) -> None:
        self.is_numbered = True
        self._last_number, self._repetitions = 0, 0
        self.restart()

    def restart(self) -> None:
        """Discard all messages."""
        self.is_shared = False
        self._series: list[_Series] = []
        self._changes: deque[_Series] = deque(maxlen=_MAX_CHANGES)

    def add(self, number: int | None, sending_time: int, arrival: float) -> None:
        """Record a message.

        Parameters
        ----------
        number
            Publication number; None or 0 if the middleware does not number messages.
        sending_time
            Sending time on the clock of the publisher [ns].
        arrival
            Time of arrival on a monotonic clock [s].
        """
        self._repetitions = self._repetitions + 1 if number == self._last_number else 1
        self._last_number = number or 0
        self.is_numbered = bool(number) and self._repetitions < _REPETITIONS
        if not number or not self.is_numbered:
            return
        self._series = [series for series in self._series if series.is_alive(arrival)]
        matches = [series for series in self._series if series.fits(number, sending_time)]
        # The list is sorted by the time of the last message; of equally close series, the most recent one is used.
        series = min(reversed(matches), key=lambda series: abs(number - series.newest), default=_Series())
        series.append(number, sending_time, arrival)
        self._series = [*(entry for entry in self._series if entry is not series), series]
        if not self._changes or self._changes[-1] is not series:
            self._changes.append(series)
            self.is_shared = self.is_shared or sum(self._changes.count(entry) > 1 for entry in self._series) > 1
