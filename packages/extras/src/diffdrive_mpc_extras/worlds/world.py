"""A world: obstacles, persons and the way through them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

import numpy as np
from pydantic import Field, model_validator

from diffdrive_mpc.models.checked_yaml import StrictModel, laid_over
from diffdrive_mpc_extras.worlds.settings import Sight, world_settings
from diffdrive_mpc_extras.worlds.shapes import Box, Mover, Point, Polygon, Post, Shapes, StandingObstacle, Wall


class Way(StrictModel):
    """What the robot is to drive along."""

    waypoints: tuple[Point, ...] = Field(min_length=2, max_length=5000, description="points x, y [m] in turn")
    speed: Annotated[float, Field(gt=0, le=10)] = Field(description="cruise speed [m/s]")


class World(StrictModel):
    """Everything around the robot in one run, as numbers."""

    description: str = Field(min_length=1, description="what there is, in one line")
    way: Way | None = Field(
        default=None, description="what it drives along; null: a trajectory that is named beside it"
    )
    time_limit: Annotated[float, Field(gt=0, le=3600)] = Field(description="by then it is to have arrived [s]")
    reachable: bool = Field(default=True, description="whether there is a way; false: it is to stop before and wait")
    ends_at_contact: bool = Field(default=True, description="whether the run ends when the robot touches something")
    walls: tuple[Wall, ...] = Field(default=(), max_length=5000)
    boxes: tuple[Box, ...] = Field(default=(), max_length=5000)
    polygons: tuple[Polygon, ...] = Field(default=(), max_length=5000)
    posts: tuple[Post, ...] = Field(default=(), max_length=5000)
    movers: tuple[Mover, ...] = Field(default=(), max_length=200)
    sight: Sight = Field(default=world_settings().sight, description="where it differs from worlds/settings.yaml")

    @model_validator(mode="before")
    @classmethod
    def _sight_is_laid_over(cls, data: Any) -> Any:  # noqa: ANN401 - what stands in a file
        if isinstance(data, Mapping) and isinstance(data.get("sight"), Mapping):
            return {**data, "sight": laid_over(world_settings().sight.model_dump(), data["sight"])}
        return data

    @property
    def outlines(self) -> tuple[tuple[str, Wall | Box | Polygon], ...]:
        """Every polygon that stands at the beginning, with its name."""
        return (
            *((f"wall {i}", wall) for i, wall in enumerate(self.walls)),
            *((f"box {i}", box) for i, box in enumerate(self.boxes)),
            *((f"polygon {i}", polygon) for i, polygon in enumerate(self.polygons)),
        )

    @property
    def changes(self) -> bool:
        """Whether anything moves or is taken away."""
        standing = (*self.walls, *self.boxes, *self.polygons, *self.posts)
        return bool(self.movers) or any(obstacle.until is not None for obstacle in standing)

    def shapes(self, time: float) -> Shapes:
        """What stands at `time` [s]; movers are not among it."""
        there = [one.corners for _, one in self.outlines if stands(one, time)]
        discs = [(*post.at, post.radius) for post in self.posts if stands(post, time)]
        return Shapes(tuple(there), np.array(discs, dtype=float).reshape(-1, 3))


def stands(obstacle: StandingObstacle, time: float) -> bool:
    """Whether an obstacle is still there at `time` [s]."""
    return obstacle.until is None or time < obstacle.until
