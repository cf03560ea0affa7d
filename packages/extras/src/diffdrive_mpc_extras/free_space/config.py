"""The schema of free space: the robot's outline, its distance to obstacles, and the range of its search."""

from __future__ import annotations

import json
from typing import Annotated, Self

from pydantic import Field, field_validator, model_validator

from diffdrive_mpc.mpc.config.group import FeatureGroup, NotNegative, Positive
from diffdrive_mpc.mpc.config.schema import ControllerConfig
from diffdrive_mpc_extras.free_space.polygons import Footprint


class FreeSpace(FeatureGroup):
    """Obstacles and corridors that the feature's `set_obstacles` takes; see packages/extras/docs/worlds.md."""

    enabled: bool = Field(False, description="keep clear of what the controller sees; false: it sees nothing [-]")
    footprint: str = Field(
        "[[0.25, 0.2], [-0.25, 0.2], [-0.25, -0.2], [0.25, -0.2]]",
        max_length=2000,
        description="corners x, y of the robot seen from its base point, as Nav2 writes them; their hull counts [m]",
    )
    footprint_radius: NotNegative = Field(
        0.0, description="by how much that hull is widened all round; one corner and a radius are a disc [m]"
    )
    margin: NotNegative = Field(0.02, description="gap that the robot keeps to all things, for what is not known [m]")
    uncertainty_factor: Annotated[float, Field(ge=0, le=6)] = Field(
        2.0, description="standard deviations of its predicted pose by which it keeps further away [-]"
    )
    reserve: NotNegative = Field(
        0.01, description="by how much further away the plan keeps than the check of its way to rest [m]"
    )
    comfort: NotNegative = Field(0.15, description="gap that its way round things has where there is room [m]")
    rows: Annotated[int, Field(ge=2, le=24)] = Field(
        8, description="soft limits at each stage; a plane takes two, of a disc one, nearest things first [-]"
    )
    strictness: Positive = Field(
        20.0, description="factor on the price of weights.soft for a plan beyond a plane, by metre [1/m]"
    )
    look_ahead: Annotated[float, Field(ge=0.5, le=20)] = Field(
        3.0, description="distance along the path for which a way round things is sought [m]"
    )
    swerve: Annotated[float, Field(ge=0, le=5)] = Field(
        0.8, description="how far its way round things may lead from the path to either side [m]"
    )
    narrow_speed: Positive = Field(
        0.3, description="speed at which the reference passes where the gap is no more than the margin [m/s]"
    )
    deceleration: Positive = Field(
        0.5, description="rate at which the reference slows down before it has to wait [m/s^2]"
    )
    moving_margin: NotNegative = Field(
        0.08, description="gap beside the margin to what moves, for what is not known of its place [m]"
    )
    disc_doubt: NotNegative = Field(0.1, description="what is not known of the speed of a moving disc [m/s]")
    disc_horizon: Annotated[float, Field(ge=0, le=10)] = Field(
        3.0, description="for so long the way of a moving disc is compared with the robot's own [s]"
    )
    max_age: Positive = Field(
        0.5, description="surroundings with a time that are older than this are not driven by: it brakes [s]"
    )
    occupied_from: Annotated[int, Field(ge=1, le=100)] = Field(
        65, description="cells of a grid with this value or more are occupied [-]"
    )
    unknown_is_free: bool = Field(
        True, description="drive over cells that are unknown, and beyond the grid; false: they are occupied [-]"
    )
    max_cells: Annotated[int, Field(ge=1, le=4_000_000)] = Field(
        250_000, description="a grid with more cells is refused [-]"
    )
    max_pieces: Annotated[int, Field(ge=1, le=20_000)] = Field(
        2000, description="surroundings of more convex pieces are refused; walls of a grid are rectangles [-]"
    )

    @field_validator("footprint", mode="before")
    @classmethod
    def _written(cls, value: object) -> object:
        """Convert a list to its text, which means the same."""
        return json.dumps(value) if isinstance(value, list) else value

    @model_validator(mode="after")
    def _has_a_footprint(self) -> Self:
        # Whoever reads a footprint raises ValueError with a sentence.
        Footprint(self.corners, self.footprint_radius)
        return self

    @property
    def corners(self) -> list[list[float]]:
        """The corners as numbers [m].

        Raises
        ------
        ValueError
            If `footprint` is no list of pairs.
        """
        try:
            listed = json.loads(self.footprint)
        except (ValueError, RecursionError) as error:
            raise ValueError("footprint: give its corners as [[x, y], [x, y], ...]") from error
        if not (isinstance(listed, list) and all(isinstance(pair, list) and len(pair) == 2 for pair in listed)):
            raise ValueError("footprint: give its corners as [[x, y], [x, y], ...]")
        return listed


def free_space_of(config: ControllerConfig) -> FreeSpace:
    """Return the group of a configuration, with its defaults if the configuration does not name it."""
    return config.feature_group("free_space", FreeSpace)
