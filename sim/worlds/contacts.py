"""What the robot touched: MuJoCo's contacts put together to events."""

from __future__ import annotations

from dataclasses import dataclass, replace


@dataclass(frozen=True, slots=True)
class Contact:
    """The robot's hull against one obstacle, from the first contact that MuJoCo found to the last.

    Attributes
    ----------
    time, until
        First and last instant [s].
    obstacle
        Name of what was touched: kind and number in the world's file, from zero.
    x, y
        Place of the first contact [m].
    speed
        Of the robot's own hull at that place, just before [m/s].
    fastest
        The same, the largest over the whole contact [m/s].
    """

    time: float
    until: float
    obstacle: str
    x: float
    y: float
    speed: float
    fastest: float

    @property
    def sentence(self) -> str:
        """What happened, in words."""
        return (
            f"t = {self.time:.2f} s: it touched {self.obstacle} at x = {self.x:.2f} m, y = {self.y:.2f} m "
            f"with {self.fastest:.2f} m/s"
        )


class ContactLog:
    """Collects contacts of all steps of the physics; `gap` [s] without one ends an event."""

    def __init__(self, gap: float) -> None:
        self._gap = gap
        self._events: list[Contact] = []
        self._last: dict[str, int] = {}

    @property
    def events(self) -> tuple[Contact, ...]:
        """Every event so far, in the order of their beginnings."""
        return tuple(self._events)

    def clear(self) -> None:
        """Forget everything."""
        self._events.clear()
        self._last.clear()

    def touched(self, time: float, obstacle: str, x: float, y: float, speed: float) -> None:
        """Enter one contact at `time` [s] and place [m], where the hull moves at `speed` [m/s]."""
        at = self._last.get(obstacle)
        if at is not None and time - self._events[at].until <= self._gap:
            event = self._events[at]
            self._events[at] = replace(event, until=time, fastest=max(event.fastest, speed))
            return
        self._last[obstacle] = len(self._events)
        self._events.append(Contact(time, time, obstacle, x, y, speed, speed))
