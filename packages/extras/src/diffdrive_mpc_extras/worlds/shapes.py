"""Obstacles of world files, and their polygons and discs in the plane."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from pydantic import Field, model_validator

from diffdrive_mpc.models.checked_yaml import StrictModel
from diffdrive_mpc.models.interface import FloatArray

Place = Annotated[float, Field(ge=-1e3, le=1e3)]
"""Coordinate [m]; the limit detects files in other units."""
Point = tuple[Place, Place]
Length = Annotated[float, Field(gt=0, le=1e3)]
Angle = Annotated[float, Field(ge=-7, le=7)]
_MIN_AREA = 1e-6


class StandingObstacle(StrictModel):
    """Base class of standing obstacles."""

    until: Annotated[float, Field(gt=0, le=1e5)] | None = Field(
        default=None, description="time at which the obstacle disappears [s]; null: it stays"
    )


class Wall(StandingObstacle):
    """A straight wall."""

    start: Point = Field(description="start of the centre line x, y [m]")
    end: Point = Field(description="end of the centre line x, y [m]")
    thickness: Length = Field(default=0.1, description="thickness [m]")

    @model_validator(mode="after")
    def _has_length(self) -> Wall:
        if self.start == self.end:
            raise ValueError("start and end coincide; move one of them, or use a post")
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

    centre: Point = Field(description="centre x, y [m]")
    size: tuple[Length, Length] = Field(description="length and width [m]")
    angle: Angle = Field(default=0.0, description="angle from x to the length, counter-clockwise [rad]")

    @property
    def corners(self) -> FloatArray:
        """(4, 2) corners [m], counter-clockwise."""
        half = 0.5 * np.array(self.size)
        c, s = math.cos(self.angle), math.sin(self.angle)
        corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * half
        return np.asarray(self.centre + corners @ np.array([[c, s], [-s, c]]))


class Polygon(StandingObstacle):
    """A convex polygon."""

    points: tuple[Point, ...] = Field(min_length=3, max_length=100, description="corners x, y in order [m]")

    @model_validator(mode="after")
    def _is_convex(self) -> Polygon:
        points = np.array(self.points)
        turns = _corner_cross_products(points)
        if not (np.all(turns > 0) or np.all(turns < 0)) or abs(_signed_area(points)) < _MIN_AREA:
            raise ValueError("points: the polygon is not convex; order its corners, or split it into convex polygons")
        return self

    @property
    def corners(self) -> FloatArray:
        """(k, 2) corners [m], counter-clockwise."""
        points = np.array(self.points)
        return points if _signed_area(points) > 0 else points[::-1]


class Post(StandingObstacle):
    """A round post."""

    at: Point = Field(description="centre x, y [m]")
    radius: Length = Field(description="radius [m]")


class Mover(StrictModel):
    """Disc, such as a person, with a constant velocity; the seed of a run may draw its values."""

    x: Place = Field(description="x at `time` [m]")
    y: Place = Field(description="y at `time` [m]")
    time: Annotated[float, Field(ge=-1e5, le=1e5)] = Field(default=0.0, description="time of the position x, y [s]")
    direction: Angle = Field(default=0.0, description="direction of motion from x, counter-clockwise [rad]")
    speed: Annotated[float, Field(ge=0, le=10)] = Field(default=0.0, description="speed [m/s]")
    radius: Annotated[float, Field(gt=0, le=5)] = Field(default=0.25, description="radius [m]")
    seen_from: Annotated[float, Field(ge=0, le=1e5)] = Field(
        default=0.0, description="time until which the sensors cannot detect the mover [s]"
    )

    @property
    def velocity(self) -> FloatArray:
        """Velocity (2,) [m/s]."""
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
        (k, 2) corners of each convex polygon [m], counter-clockwise.
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
    offsets = points[:, None] - corners
    fraction = np.clip((offsets * edges).sum(-1) / (edges * edges).sum(-1), 0.0, 1.0)
    distance = np.hypot(*(offsets - fraction[..., None] * edges).transpose(2, 0, 1)).min(axis=1)
    inside = np.all(edges[:, 0] * offsets[..., 1] - edges[:, 1] * offsets[..., 0] >= 0, axis=1)
    return np.where(inside, 0.0, distance)


def _corner_cross_products(points: FloatArray) -> FloatArray:
    """Compute the cross product (k,) of the two edges at each corner [m^2]; positive at a left turn."""
    edges = np.roll(points, -1, axis=0) - points
    next_edges = np.roll(edges, -1, axis=0)
    return np.asarray(edges[:, 0] * next_edges[:, 1] - edges[:, 1] * next_edges[:, 0])


def _signed_area(points: FloatArray) -> float:
    """Compute the area of a polygon (k, 2) [m^2]; positive if counter-clockwise."""
    next_points = np.roll(points, -1, axis=0)
    return float(0.5 * np.sum(points[:, 0] * next_points[:, 1] - next_points[:, 0] * points[:, 1]))
