"""World files: obstacles, persons and the path between them."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field, model_validator

from diffdrive_mpc.models.checked_yaml import ConfigError, StrictModel, check, merge_mappings, read_yaml
from diffdrive_mpc.models.named_file import named_file
from diffdrive_mpc.sim.disturbances.drawn_values import check_random_values, draw_values, extremes
from diffdrive_mpc_extras.worlds.settings import Sight, world_settings
from diffdrive_mpc_extras.worlds.shapes import Box, Mover, Point, Polygon, Post, Shapes, StandingObstacle, Wall


class DrivePath(StrictModel):
    """Path of the robot."""

    waypoints: tuple[Point, ...] = Field(min_length=2, max_length=5000, description="points x, y in order [m]")
    speed: Annotated[float, Field(gt=0, le=10)] = Field(description="cruise speed [m/s]")


class World(StrictModel):
    """Surroundings of the robot in one run."""

    description: str = Field(min_length=1, description="description of the world in one line")
    way: DrivePath | None = Field(default=None, description="path of the robot; null: the trajectory of the run")
    time_limit: Annotated[float, Field(gt=0, le=3600)] = Field(description="time limit of the arrival [s]")
    reachable: bool = Field(default=True, description="true if a free path exists; false: the robot must stop and wait")
    ends_at_contact: bool = Field(default=True, description="true if a contact of the moving robot ends the run")
    walls: tuple[Wall, ...] = Field(default=(), max_length=5000)
    boxes: tuple[Box, ...] = Field(default=(), max_length=5000)
    polygons: tuple[Polygon, ...] = Field(default=(), max_length=5000)
    posts: tuple[Post, ...] = Field(default=(), max_length=5000)
    movers: tuple[Mover, ...] = Field(default=(), max_length=200)
    sight: Sight = Field(default=world_settings().sight, description="changes to the sight of worlds/settings.yaml")

    @model_validator(mode="before")
    @classmethod
    def _merge_sight(cls, data: Any) -> Any:  # noqa: ANN401 - content of a file
        if isinstance(data, Mapping) and isinstance(data.get("sight"), Mapping):
            return {**data, "sight": merge_mappings(world_settings().sight.model_dump(), data["sight"])}
        return data

    @property
    def outlines(self) -> tuple[tuple[str, Wall | Box | Polygon], ...]:
        """Name and shape of each obstacle with straight edges."""
        return (
            *((f"wall {i}", wall) for i, wall in enumerate(self.walls)),
            *((f"box {i}", box) for i, box in enumerate(self.boxes)),
            *((f"polygon {i}", polygon) for i, polygon in enumerate(self.polygons)),
        )

    @property
    def changes(self) -> bool:
        """True if an obstacle moves or disappears."""
        standing = (*self.walls, *self.boxes, *self.polygons, *self.posts)
        return bool(self.movers) or any(obstacle.until is not None for obstacle in standing)

    def shapes(self, time: float) -> Shapes:
        """Return the standing obstacles at `time` [s], without movers."""
        corners = [outline.corners for _, outline in self.outlines if is_present(outline, time)]
        discs = [(*post.at, post.radius) for post in self.posts if is_present(post, time)]
        return Shapes(tuple(corners), np.array(discs, dtype=float).reshape(-1, 3))


def is_present(obstacle: StandingObstacle, time: float) -> bool:
    """Return True if a standing obstacle is present at `time` [s]."""
    return obstacle.until is None or time < obstacle.until


SHIPPED = Path(__file__).parent / "shipped"
PATTERN = "drawn:SEED, drawn:SEED:through"
"""Pattern of the names of drawn worlds."""
# Sensors, encoders and scenarios use the spawn keys 0 to 2, 1000 and 2080; a world does not change their draws.
_SPAWN_KEY = 3_001


def load_world(name: str | Path, seed: int = 0) -> World:
    """Load the world of a run.

    Parameters
    ----------
    name
        Name of a shipped world, path of a file, or `drawn:SEED` or `drawn:SEED:through` (see `drawn_world`).
    seed
        Seed of the run, not negative; it draws the values of movers that the file gives as ranges.

    Raises
    ------
    models.checked_yaml.ConfigError
        If the world does not exist, its file is invalid, or a range includes an invalid value.
    """
    match = re.fullmatch(r"drawn:(\d{1,18})(:through)?", str(name), re.ASCII)
    if match:
        from diffdrive_mpc_extras.worlds.drawn_world import drawn_world  # noqa: PLC0415 - loads SciPy

        return drawn_world(int(match[1]), through=match[2] is not None)
    if str(name).startswith("drawn"):
        raise ConfigError(f"world '{name}': the name of a random world is {PATTERN}, with a number for SEED")
    path = named_file("world", SHIPPED, name, others=f", {PATTERN}")
    data = read_yaml(path)
    return _with_movers(data, seed, str(path))


def _with_movers(data: Any, seed: int, where: str) -> World:  # noqa: ANN401 - content of a file
    """Build the world; ranges are drawn for movers only, because two numbers elsewhere are a point."""
    movers = data.get("movers") if isinstance(data, Mapping) else None
    if not isinstance(movers, list):
        return check(World, data, where)
    check_random_values(movers, f"{where}: movers")
    for values in extremes(movers):
        check(World, {**data, "movers": values}, where)
    stream = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(_SPAWN_KEY,)))
    return check(World, {**data, "movers": draw_values(movers, stream)}, where)
