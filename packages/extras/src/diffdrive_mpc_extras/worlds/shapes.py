"""Obstacles as in their files, and as polygons and discs in the plane."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from pydantic import Field, model_validator

from diffdrive_mpc.models.checked_yaml import StrictModel
from diffdrive_mpc.models.interface import FloatArray

Place = Annotated[float, Field(ge=-1e3, le=1e3)]
"""A coordinate [m]: a world that is larger was meant in other units."""
Point = tuple[Place, Place]
Length = Annotated[float, Field(gt=0, le=1e3)]
Angle = Annotated[float, Field(ge=-7, le=7)]
_LEAST_AREA = 1e-6


class StandingObstacle(StrictModel):
    """Base class of standing obstacles."""

    until: Annotated[float, Field(gt=0, le=1e5)] | None = Field(
        default=None, description="it is taken away at this time [s]; null: it stays"
    )


class Wall(StandingObstacle):
    """A straight wall."""

    start: Point = Field(description="one end of its middle line, x, y [m]")
    end: Point = Field(description="the other end [m]")
    thickness: Length = Field(default=0.1, description="thickness [m]")

    @model_validator(mode="after")
    def _has_length(self) -> Wall:
        if self.start == self.end:
            raise ValueError("start and end coincide; give a wall of some length, or a post")
        return self

    @property
    def corners(self) -> FloatArray:
        """(4, 2) corners [m], counter-clockwise."""
        a, b = np.array(self.start), np.array(self.end)
        along = (b - a) / np.linalg.norm(b - a)
        side = 0.5 * self.thickness * np.array([-along[1], along[0]])
        return np.array([a - side, b - side, b + side, a + side])


class Box(StandingObstacle):
    """A rectangle."""

    centre: Point = Field(description="x, y [m]")
    size: tuple[Length, Length] = Field(description="length and width [m]")
    angle: Angle = Field(default=0.0, description="of its length, turned to the left from x [rad]")

    @property
    def corners(self) -> FloatArray:
        """(4, 2) corners [m], counter-clockwise."""
        half = 0.5 * np.array(self.size)
        c, s = math.cos(self.angle), math.sin(self.angle)
        corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * half
        return np.asarray(self.centre + corners @ np.array([[c, s], [-s, c]]))


class Polygon(StandingObstacle):
    """A convex polygon."""

    points: tuple[Point, ...] = Field(min_length=3, max_length=100, description="corners x, y [m] in turn")

    @model_validator(mode="after")
    def _is_convex(self) -> Polygon:
        turns = _turns(np.array(self.points))
        if not (np.all(turns > 0) or np.all(turns < 0)) or abs(_area(np.array(self.points))) < _LEAST_AREA:
            raise ValueError("points: give a convex polygon, its corners in turn; make several of one that is not")
        return self

    @property
    def corners(self) -> FloatArray:
        """(k, 2) corners [m], counter-clockwise."""
        points = np.array(self.points)
        return points if _area(points) > 0 else points[::-1]


class Post(StandingObstacle):
    """A round post."""

    at: Point = Field(description="x, y of its middle [m]")
    radius: Length = Field(description="radius [m]")


class Mover(StrictModel):
    """A round body, such as a person, that walks straight on at a constant speed; a run's seed may draw its values."""

    x: Place = Field(description="where it is at `time` [m]")
    y: Place = Field(description="where it is at `time` [m]")
    time: Annotated[float, Field(ge=-1e5, le=1e5)] = Field(default=0.0, description="when it is at x, y [s]")
    direction: Angle = Field(default=0.0, description="where it walks to, turned to the left from x [rad]")
    speed: Annotated[float, Field(ge=0, le=10)] = Field(default=0.0, description="how fast it walks [m/s]")
    radius: Annotated[float, Field(gt=0, le=5)] = Field(default=0.25, description="radius [m]")
    seen_from: Annotated[float, Field(ge=0, le=1e5)] = Field(
        default=0.0, description="hidden from the robot until then [s]"
    )

    @property
    def velocity(self) -> FloatArray:
        """(2,) [m/s]."""
        return self.speed * np.array([math.cos(self.direction), math.sin(self.direction)])

    def position(self, time: float) -> FloatArray:
        """Compute the position (2,) x, y [m] at `time` [s]."""
        return np.array([self.x, self.y]) + (time - self.time) * self.velocity


@dataclass(frozen=True, eq=False)
class Shapes:
    """Obstacles at an instant.

    Attributes
    ----------
    polygons
        (k, 2) corners of each convex one [m], counter-clockwise.
    discs
        (n, 3) x, y, radius [m].
    """

    polygons: tuple[FloatArray, ...]
    discs: FloatArray

    def distance(self, points: FloatArray) -> FloatArray:
        """Compute distances (m,) of points (m, 2) from the nearest obstacle [m]; negative inside a disc."""
        distances = np.full(len(points), np.inf)
        if len(self.discs):
            gaps = np.hypot(*(points[:, None] - self.discs[None, :, :2]).transpose(2, 0, 1)) - self.discs[:, 2]
            distances = gaps.min(axis=1)
        for corners in self.polygons:
            distances = np.minimum(distances, distance_to_polygon(points, corners))
        return distances


def distance_to_polygon(points: FloatArray, corners: FloatArray) -> FloatArray:
    """Compute distances (m,) of points (m, 2) from a convex polygon (k, 2), counter-clockwise [m]; zero inside."""
    edges = np.roll(corners, -1, axis=0) - corners
    gaps = points[:, None] - corners
    share = np.clip((gaps * edges).sum(-1) / (edges * edges).sum(-1), 0.0, 1.0)
    nearest = np.hypot(*(gaps - share[..., None] * edges).transpose(2, 0, 1)).min(axis=1)
    inside = np.all(edges[:, 0] * gaps[..., 1] - edges[:, 1] * gaps[..., 0] >= 0, axis=1)
    return np.where(inside, 0.0, nearest)


def _turns(points: FloatArray) -> FloatArray:
    edges = np.roll(points, -1, axis=0) - points
    after = np.roll(edges, -1, axis=0)
    return np.asarray(edges[:, 0] * after[:, 1] - edges[:, 1] * after[:, 0])


def _area(points: FloatArray) -> float:
    after = np.roll(points, -1, axis=0)
    return float(0.5 * np.sum(points[:, 0] * after[:, 1] - after[:, 0] * points[:, 1]))
