"""Evaluation of a run in a world: arrival, contacts and clearance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc_extras.worlds.settings import world_settings
from diffdrive_mpc_extras.worlds.shapes import Shapes
from diffdrive_mpc_extras.worlds.world import World


@dataclass(frozen=True, slots=True)
class Contact:
    """Contact event between the robot's hull and one obstacle, combined from MuJoCo contacts of successive steps.

    Attributes
    ----------
    time, until
        Start and end of the event [s].
    obstacle
        Name of the obstacle: kind and zero-based index in the world's file.
    x, y
        Position of the first contact point [m].
    speed
        Speed of the hull at that point just before the first contact [m/s].
    max_speed
        Maximum speed of the hull at the contact points of the event [m/s].
    """

    time: float
    until: float
    obstacle: str
    x: float
    y: float
    speed: float
    max_speed: float

    @property
    def sentence(self) -> str:
        """Description of the contact for people."""
        return (
            f"t = {self.time:.2f} s: the robot touched {self.obstacle} at x = {self.x:.2f} m, y = {self.y:.2f} m "
            f"with {self.max_speed:.2f} m/s"
        )


class ContactLog:
    """Log that combines contacts of physics steps to events; `gap` [s] without contact ends an event."""

    def __init__(self, gap: float) -> None:
        self._gap = gap
        self._events: list[Contact] = []
        self._index_by_obstacle: dict[str, int] = {}

    @property
    def events(self) -> tuple[Contact, ...]:
        """All events, ordered by start time."""
        return tuple(self._events)

    def clear(self) -> None:
        """Delete all events."""
        self._events.clear()
        self._index_by_obstacle.clear()

    def record(self, time: float, obstacle: str, x: float, y: float, speed: float) -> None:
        """Record a contact at `time` [s] and point `x`, `y` [m], where the hull moves at `speed` [m/s]."""
        index = self._index_by_obstacle.get(obstacle)
        if index is not None and time - self._events[index].until <= self._gap:
            event = self._events[index]
            self._events[index] = replace(event, until=time, max_speed=max(event.max_speed, speed))
            return
        self._index_by_obstacle[obstacle] = len(self._events)
        self._events.append(Contact(time, time, obstacle, x, y, speed, speed))


_CLEARANCE_STRIDE = 5
"""Number of ticks between two evaluations of the clearance."""
_OUTLINE_STEP = 0.03
"""Maximum distance between points of the outline [m]."""


@dataclass(frozen=True, slots=True)
class Passage:
    """Result of a run through a world.

    Attributes
    ----------
    arrived
        True if the robot stopped at the goal within the time limit without a contact while it moved.
    time_s
        Time of arrival [s]; NaN if the robot did not arrive.
    contacts
        Number of contacts while the robot moved.
    walked_into
        Number of contacts while the robot stood.
    contact_speed_m_s
        Maximum speed of the hull at a contact [m/s]; NaN without contacts.
    clearance_m
        Minimum distance of the robot's outline from any obstacle [m]: zero after a contact, infinite in an empty world.
        It is evaluated every five ticks at points of the outline at most 3 cm apart.
    standing_s
        Total standstill before the arrival [s].
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
    """Evaluate a run of n ticks.

    Parameters
    ----------
    world, outline, contacts
        Fields of `WorldRecord`.
    goal
        (3,) pose x, y [m], theta [rad] at the end of the path.
    time, pose, twist
        (n,) time [s], (n, 3) true poses [m, m, rad] and (n, 3) true twists [m/s, m/s, rad/s].
    """
    rules = world_settings()
    moving = [contact for contact in contacts if contact.max_speed > rules.contact.moving_speed]
    speed = np.hypot(twist[:, 0], twist[:, 1])
    at_goal = np.hypot(*(pose[:, :2] - goal[:2]).T) <= rules.goal.distance
    arrivals = np.flatnonzero(at_goal & (speed <= rules.goal.speed) & (time <= world.time_limit))
    arrived = bool(arrivals.size) and not moving
    end = arrivals[0] if arrived else len(time) - 1
    standing_ticks = (speed[: end + 1] <= rules.contact.moving_speed).sum()
    tick = float(time[1] - time[0]) if len(time) > 1 else 0.0
    return Passage(
        arrived=arrived,
        time_s=float(time[arrivals[0]]) if arrived else float("nan"),
        contacts=len(moving),
        walked_into=len(contacts) - len(moving),
        contact_speed_m_s=max((event.max_speed for event in moving), default=float("nan")),
        clearance_m=0.0 if contacts else min_clearance(world, outline, time, pose),
        standing_s=float(standing_ticks) * tick,
    )


def min_clearance(world: World, outline: tuple[float, float], time: FloatArray, pose: FloatArray) -> float:
    """Compute the minimum distance [m] of the robot's outline from any obstacle over a run, as in `Passage`."""
    body_points, clearance = outline_points(outline), np.inf
    for t, (x, y, theta) in zip(time[::_CLEARANCE_STRIDE], pose[::_CLEARANCE_STRIDE], strict=True):
        c, s = np.cos(theta), np.sin(theta)
        points = np.array([x, y]) + body_points @ np.array([[c, s], [-s, c]])
        shapes = world.shapes(float(t))
        discs = [shapes.discs, *(np.array([[*mover.position(float(t)), mover.radius]]) for mover in world.movers)]
        nearby = np.vstack(discs)
        nearby = nearby[np.hypot(nearby[:, 0] - x, nearby[:, 1] - y) - nearby[:, 2] < clearance + max(outline)]
        clearance = min(clearance, float(Shapes(shapes.polygons, nearby).distance(points).min(initial=np.inf)))
    return max(0.0, clearance)


def outline_points(outline: tuple[float, float]) -> FloatArray:
    """Compute points (n, 2) along the outline of the robot in the body frame [m]."""
    length, width = outline
    corners = 0.5 * np.array([[length, width], [-length, width], [-length, -width], [length, -width]])
    edges = np.roll(corners, -1, axis=0) - corners
    counts = np.ceil(np.hypot(*edges.T) / _OUTLINE_STEP).astype(int)
    return np.vstack([a + np.arange(k)[:, None] / k * edge for a, edge, k in zip(corners, edges, counts, strict=True)])
