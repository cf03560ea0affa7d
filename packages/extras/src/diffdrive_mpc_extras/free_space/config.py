"""Configuration schema of free space: footprint, distances to obstacles, and range of the path search."""

from __future__ import annotations

import json
from typing import Annotated, Self

from pydantic import Field, field_validator, model_validator

from diffdrive_mpc.mpc.config.group import FeatureGroup, NotNegative, Positive
from diffdrive_mpc.mpc.config.schema import ControllerConfig
from diffdrive_mpc_extras.free_space.polygons import Footprint


class FreeSpace(FeatureGroup):
    """Obstacle avoidance for the surroundings passed to `set_obstacles`; see packages/extras/docs/worlds.md."""

    enabled: bool = Field(False, description="keep clear of the surroundings; false: ignore them [-]")
    footprint: str = Field(
        "[[0.25, 0.2], [-0.25, 0.2], [-0.25, -0.2], [0.25, -0.2]]",
        max_length=2000,
        description="corners x, y relative to the base point, in the format of Nav2; their convex hull is used [m]",
    )
    footprint_radius: NotNegative = Field(
        0.0, description="radius by which the hull is inflated; one corner and a radius define a disc [m]"
    )
    margin: NotNegative = Field(0.02, description="minimum gap to all obstacles, for their unknown errors [m]")
    uncertainty_factor: Annotated[float, Field(ge=0, le=6)] = Field(
        2.0, description="number of standard deviations of the predicted pose that are added to the margin [-]"
    )
    reserve: NotNegative = Field(
        0.01, description="additional margin of the plan over the margin of the stopping-path check [m]"
    )
    comfort: NotNegative = Field(0.15, description="preferred gap of the path around obstacles [m]")
    rows: Annotated[int, Field(ge=2, le=24)] = Field(
        8, description="soft half-space rows per stage, nearest obstacles first; a plane needs 2 rows (a disc: 1) [-]"
    )
    strictness: Positive = Field(20.0, description="factor on the penalty weights.soft, per metre of violation [1/m]")
    look_ahead: Annotated[float, Field(ge=0.5, le=20)] = Field(
        3.0, description="distance along the path over which a path around obstacles is searched [m]"
    )
    swerve: Annotated[float, Field(ge=0, le=5)] = Field(
        0.8, description="maximum lateral offset of the path around obstacles [m]"
    )
    narrow_speed: Positive = Field(0.3, description="speed of the reference where the gap equals the margin [m/s]")
    deceleration: Positive = Field(
        0.5, description="deceleration of the reference before a stop or a narrow place [m/s^2]"
    )
    moving_margin: NotNegative = Field(
        0.08, description="additional margin to moving obstacles, for the uncertainty of their position [m]"
    )
    disc_doubt: NotNegative = Field(0.1, description="uncertainty of the speed of a moving disc [m/s]")
    disc_horizon: Annotated[float, Field(ge=0, le=10)] = Field(
        3.0, description="time over which the paths of moving discs are compared with the path of the robot [s]"
    )
    max_age: Positive = Field(
        0.5, description="maximum age of surroundings with a time stamp; the robot brakes if they are older [s]"
    )
    occupied_from: Annotated[int, Field(ge=1, le=100)] = Field(
        65, description="minimum value of an occupied grid cell [-]"
    )
    unknown_is_free: bool = Field(
        True, description="treat unknown cells and the area outside the grid as free; false: as occupied [-]"
    )
    max_cells: Annotated[int, Field(ge=1, le=4_000_000)] = Field(
        250_000, description="maximum number of grid cells; larger grids are rejected [-]"
    )
    max_pieces: Annotated[int, Field(ge=1, le=20_000)] = Field(
        2000, description="maximum number of convex pieces, including the rectangles of a grid; more are rejected [-]"
    )

    @field_validator("footprint", mode="before")
    @classmethod
    def _as_text(cls, value: object) -> object:
        """Convert a list of corners to its JSON text."""
        return json.dumps(value) if isinstance(value, list) else value

    @model_validator(mode="after")
    def _check_footprint(self) -> Self:
        # Footprint raises ValueError if the corners are invalid.
        Footprint(self.corners, self.footprint_radius)
        return self

    @property
    def corners(self) -> list[list[float]]:
        """Corners as pairs of numbers [m].

        Raises
        ------
        ValueError
            If `footprint` is not a list of pairs.
        """
        try:
            listed = json.loads(self.footprint)
        except (ValueError, RecursionError) as error:
            raise ValueError("footprint: give its corners as [[x, y], [x, y], ...]") from error
        if not (isinstance(listed, list) and all(isinstance(pair, list) and len(pair) == 2 for pair in listed)):
            raise ValueError("footprint: give its corners as [[x, y], [x, y], ...]")
        return listed


def free_space_of(config: ControllerConfig) -> FreeSpace:
    """Return the `free_space` group of a configuration, with the defaults if the group is missing."""
    return config.feature_group("free_space", FreeSpace)
