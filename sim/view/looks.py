"""Typed looks of robot, floors and marks."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Annotated

from pydantic import Field

from diffdrive_mpc.models.checked_yaml import StrictModel, load_checked
from diffdrive_mpc.models.robot import Positive

Share = Annotated[float, Field(ge=0, le=1)]
Colour = tuple[Share, Share, Share]


class Line(StrictModel):
    """A line in space."""

    colour: Colour = Field(description="red, green, blue")
    radius: Positive = Field(description="half its thickness [m]")


class Marks(StrictModel):
    """What is drawn into the scene."""

    reference: Line
    band: Colour
    way: Line
    plan: Line


class Floor(StrictModel):
    """A chequered floor."""

    shades: tuple[Colour, Colour] = Field(description="of its squares")
    mirrors: Share = Field(description="how much it mirrors")


class Sky(StrictModel):
    """What is behind the floor."""

    above: Colour = Field(description="overhead")
    below: Colour = Field(description="at the horizon")


class Looks(StrictModel):
    """Of everything in a picture."""

    body: Colour = Field(description="box of the robot")
    top: Colour = Field(description="its deck")
    front: Colour = Field(description="the mark at its front")
    tyre: Colour = Field(description="rubber")
    rim: Colour = Field(description="wheels inside their tyres")
    sensor: Colour = Field(description="the turret on the deck")
    sky: Sky
    marks: Marks
    floors: dict[str, Floor] = Field(description="by name of the surface; others look like `default`")

    def floor(self, surface: str) -> Floor:
        """That of a surface by shipped name; for others the default one."""
        return self.floors.get(surface, self.floors["default"])


@cache
def load_looks() -> Looks:
    """Read the shipped looks; raises ConfigError when the file has a mistake."""
    return load_checked(Looks, Path(__file__).parent / "looks.yaml")
