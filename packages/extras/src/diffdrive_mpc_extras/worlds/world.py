"""A world: obstacles, persons and the way between them."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field, model_validator

from diffdrive_mpc.models.checked_yaml import ConfigError, StrictModel, check, merge_mappings, read_yaml
from diffdrive_mpc.models.named_file import named_file
from diffdrive_mpc.sim.disturbances.drawn_values import check_drawn, draw_values, extremes
from diffdrive_mpc_extras.worlds.settings import Sight, world_settings
from diffdrive_mpc_extras.worlds.shapes import Box, Mover, Point, Polygon, Post, Shapes, StandingObstacle, Wall


class Way(StrictModel):
    """Path of the robot."""

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
            return {**data, "sight": merge_mappings(world_settings().sight.model_dump(), data["sight"])}
        return data

    @property
    def outlines(self) -> tuple[tuple[str, Wall | Box | Polygon], ...]:
        """Every polygon at the beginning, with its name."""
        return (
            *((f"wall {i}", wall) for i, wall in enumerate(self.walls)),
            *((f"box {i}", box) for i, box in enumerate(self.boxes)),
            *((f"polygon {i}", polygon) for i, polygon in enumerate(self.polygons)),
        )

    @property
    def changes(self) -> bool:
        """True if anything moves or disappears."""
        standing = (*self.walls, *self.boxes, *self.polygons, *self.posts)
        return bool(self.movers) or any(obstacle.until is not None for obstacle in standing)

    def shapes(self, time: float) -> Shapes:
        """Return the standing obstacles at `time` [s], without movers."""
        corners = [outline.corners for _, outline in self.outlines if stands(outline, time)]
        discs = [(*post.at, post.radius) for post in self.posts if stands(post, time)]
        return Shapes(tuple(corners), np.array(discs, dtype=float).reshape(-1, 3))


def stands(obstacle: StandingObstacle, time: float) -> bool:
    """Return True if an obstacle is still present at `time` [s]."""
    return obstacle.until is None or time < obstacle.until


SHIPPED = Path(__file__).parent / "shipped"
PATTERN = "drawn:SEED, drawn:SEED:through"
"""Pattern of the names of drawn worlds."""
# Spawn keys of sensors, encoders and scenarios are 0 to 2, 1000 and 2080: a world changes none of their draws.
_SPAWN_KEY = 3_001


def load_world(name: str | Path, seed: int = 0) -> World:
    """Load the world of a run.

    Parameters
    ----------
    name
        A shipped world, the path of a file, or `drawn:SEED` or `drawn:SEED:through` (see `drawn_world`).
    seed
        Seed of the run, not negative: values of the movers that a file leaves open are drawn from it.

    Raises
    ------
    models.checked_yaml.ConfigError
        If there is no such world, its file has a mistake, or a value out of range could be drawn from it.
    """
    match = re.fullmatch(r"drawn:(\d{1,18})(:through)?", str(name), re.ASCII)
    if match:
        from diffdrive_mpc_extras.worlds.drawn_world import drawn_world  # noqa: PLC0415 - loads SciPy

        return drawn_world(int(match[1]), through=match[2] is not None)
    if str(name).startswith("drawn"):
        raise ConfigError(f"world '{name}': a drawn one is called {PATTERN}, SEED being a number")
    path = named_file("world", SHIPPED, name, others=f", {PATTERN}")
    data = read_yaml(path)
    return _with_movers(data, seed, str(path))


def _with_movers(data: Any, seed: int, where: str) -> World:  # noqa: ANN401 - what stands in a file
    """Build the world with ranges for movers only, since two numbers elsewhere are a point."""
    movers = data.get("movers") if isinstance(data, Mapping) else None
    if not isinstance(movers, list):
        return check(World, data, where)
    check_drawn(movers, f"{where}: movers")
    for values in extremes(movers):
        check(World, {**data, "movers": values}, where)
    stream = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(_SPAWN_KEY,)))
    return check(World, {**data, "movers": draw_values(movers, stream)}, where)
