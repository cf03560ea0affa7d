"""What of a robot can be seen: the lengths of its body and wheels."""

from __future__ import annotations

from dataclasses import dataclass

from diffdrive_mpc.models.robot import Robot, load_robot
from diffdrive_mpc.sim.plants.make import PHYSICS
from diffdrive_mpc.sim.plants.simulated_robot import load_simulated_robot
from diffdrive_mpc.sim.plants.twin_parameters import ChassisParameters, load_twin_parameters


@dataclass(frozen=True)
class Body:
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


def robot_body(plant: str = PHYSICS) -> Body | None:
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


def _body(robot: Robot, chassis: ChassisParameters) -> Body:
    return Body(robot.track, chassis.wheel_base, robot.wheel_radius, chassis.body_size, chassis.body_height)
