"""What of a robot can be seen: the lengths of its body and wheels."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Annotated

from pydantic import Field

from diffdrive_mpc.models.checked_yaml import StrictModel, load_checked
from diffdrive_mpc.models.robot import Positive, Robot, load_robot
from diffdrive_mpc.sim.plants.names import PHYSICS
from diffdrive_mpc.sim.plants.simulated_robot import load_simulated_robot
from diffdrive_mpc.sim.plants.twin_parameters import ChassisParameters, load_twin_parameters


@dataclass(frozen=True)
class BodyShape:
    """Lengths of a robot on four wheels [m].

    Attributes
    ----------
    track, wheel_base, wheel_radius
        Of its wheels.
    size
        (3,) length, width, height of the box between them.
    height
        Centre of the box above the axles.
    """

    track: float
    wheel_base: float
    wheel_radius: float
    size: tuple[float, float, float]
    height: float

    @property
    def footprint(self) -> tuple[float, float]:
        """Length and width of the whole robot, wheels included [m]."""
        length = max(self.size[0], self.wheel_base + 2 * self.wheel_radius)
        return length, max(self.size[1], self.track + self.wheel_width)

    @property
    def top(self) -> float:
        """Height of the box over the floor [m]."""
        return self.wheel_radius + self.height + 0.5 * self.size[2]

    @property
    def wheel_width(self) -> float:
        """As wide as fits beside the box, and at most two thirds of the radius [m]; no file says it."""
        return min(2 / 3 * self.wheel_radius, max(self.track - self.size[1], 0.4 * self.wheel_radius))


def robot_body(plant: str = PHYSICS) -> BodyShape | None:
    """The body of a plant by the name that `make_plant` takes; None for one that has none ("model:...").

    Raises
    ------
    models.checked_yaml.ConfigError
        If there is no such robot or its file has a mistake.
    """
    if plant == PHYSICS:
        return _body(load_robot(), load_twin_parameters().chassis)
    if not plant.startswith(f"{PHYSICS}:"):
        return None
    robot = load_simulated_robot(plant.removeprefix(f"{PHYSICS}:"))
    return _body(robot.robot, robot.twin.chassis)


def _body(robot: Robot, chassis: ChassisParameters) -> BodyShape:
    return BodyShape(robot.track, chassis.wheel_base, robot.wheel_radius, chassis.body_size, chassis.body_height)


# Typed looks of robot, floors and marks.


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


class ChequeredFloor(StrictModel):
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
    floors: dict[str, ChequeredFloor] = Field(description="by name of the surface; others look like `default`")

    def floor(self, surface: str) -> ChequeredFloor:
        """That of a surface by shipped name; for others the default one."""
        return self.floors.get(surface, self.floors["default"])


@cache
def load_looks() -> Looks:
    """Read the shipped looks; raises ConfigError when the file has a mistake."""
    return load_checked(Looks, Path(__file__).parent / "looks.yaml")
