"""Passage of a run through its world: arrival, contacts and clearance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc_extras.worlds.settings import world_settings
from diffdrive_mpc_extras.worlds.shapes import Shapes
from diffdrive_mpc_extras.worlds.world import World

# Contacts of the robot: MuJoCo's contacts combined to events.


@dataclass(frozen=True, slots=True)
class Contact:
    """The robot's hull against one obstacle, from the first contact that MuJoCo found to the last.

    Attributes
    ----------
    time, until
        First and last instant [s].
    obstacle
        Name of the touched object: kind and number in the world's file, from zero.
    x, y
        Place of the first contact [m].
    speed
        Speed of the robot's own hull at that place, just before [m/s].
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
        """Describe the result in words."""
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
        index = self._last.get(obstacle)
        if index is not None and time - self._events[index].until <= self._gap:
            event = self._events[index]
            self._events[index] = replace(event, until=time, fastest=max(event.fastest, speed))
            return
        self._last[obstacle] = len(self._events)
        self._events.append(Contact(time, time, obstacle, x, y, speed, speed))


_LOOKED_AT = 5
"""Number of ticks between two measurements of the clearance."""
_OUTLINE_STEP = 0.03
"""Between points of the outline at which it is taken [m]."""


@dataclass(frozen=True, slots=True)
class Passage:
    """Passage of a run through a world.

    Attributes
    ----------
    arrived
        Whether it stood at the end of its way within the time limit, and had touched nothing while it moved.
    time_s
        Time at which it came to stand there [s]; NaN where it did not.
    contacts
        Number of obstacles that it touched while it moved.
    walked_into
        Number of persons who touched it while it stood.
    contact_speed_m_s
        Fastest of its own hull at a contact; NaN without one.
    clearance_m
        Least distance of its outline from anything, zero at a contact; infinite in an empty world. Taken every five
        ticks at points of the outline 3 cm apart.
    standing_s
        Time for which it stood on the way [s].
    """

    arrived: bool
    time_s: float
    contacts: int
    walked_into: int
    contact_speed_m_s: float
    clearance_m: float
    standing_s: float


def passage_of(
    world: World,
    outline: tuple[float, float],
    contacts: Sequence[Contact],
    goal: FloatArray,
    time: FloatArray,
    pose: FloatArray,
    twist: FloatArray,
) -> Passage:
    """Evaluate the passage of a run of n ticks.

    Parameters
    ----------
    world, outline, contacts
        As in `sim.run.Run`.
    goal
        (3,) pose at the end of the way.
    time, pose, twist
        (n,) [s], (n, 3) true poses and (n, 3) true twists.
    """
    rules = world_settings()
    moving = [contact for contact in contacts if contact.fastest > rules.contact.moving_speed]
    speed = np.hypot(twist[:, 0], twist[:, 1])
    near = np.hypot(*(pose[:, :2] - goal[:2]).T) <= rules.goal.distance
    arrivals = np.flatnonzero(near & (speed <= rules.goal.speed) & (time <= world.time_limit))
    arrived = bool(arrivals.size) and not moving
    until = arrivals[0] if arrived else len(time) - 1
    stood = (speed[: until + 1] <= rules.contact.moving_speed).sum()
    tick = float(time[1] - time[0]) if len(time) > 1 else 0.0
    return Passage(
        arrived=arrived,
        time_s=float(time[arrivals[0]]) if arrived else float("nan"),
        contacts=len(moving),
        walked_into=len(contacts) - len(moving),
        contact_speed_m_s=max((event.fastest for event in moving), default=float("nan")),
        clearance_m=0.0 if contacts else least_clearance(world, outline, time, pose),
        standing_s=float(stood) * tick,
    )


def least_clearance(world: World, outline: tuple[float, float], time: FloatArray, pose: FloatArray) -> float:
    """Compute the least distance [m] of the robot's outline from any obstacle over a run, as in `Passage`."""
    around, clearance = outline_points(outline), np.inf
    for t, (x, y, theta) in zip(time[::_LOOKED_AT], pose[::_LOOKED_AT], strict=True):
        c, s = np.cos(theta), np.sin(theta)
        points = np.array([x, y]) + around @ np.array([[c, s], [-s, c]])
        shapes = world.shapes(float(t))
        discs = [shapes.discs, *(np.array([[*mover.position(float(t)), mover.radius]]) for mover in world.movers)]
        nearby = np.vstack(discs)
        nearby = nearby[np.hypot(nearby[:, 0] - x, nearby[:, 1] - y) - nearby[:, 2] < clearance + max(outline)]
        clearance = min(clearance, float(Shapes(shapes.polygons, nearby).distance(points).min(initial=np.inf)))
    return max(0.0, clearance)


def outline_points(outline: tuple[float, float]) -> FloatArray:
    """Compute points (n, 2) along the outline of the robot in its own frame [m]."""
    length, width = outline
    corners = 0.5 * np.array([[length, width], [-length, width], [-length, -width], [length, -width]])
    edges = np.roll(corners, -1, axis=0) - corners
    counts = np.ceil(np.hypot(*edges.T) / _OUTLINE_STEP).astype(int)
    return np.vstack([a + np.arange(k)[:, None] / k * edge for a, edge, k in zip(corners, edges, counts, strict=True)])
