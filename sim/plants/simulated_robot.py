"""Robots of plant `mujoco`, defined in YAML files by their differences from the digital twin."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pydantic import Field, model_validator

from diffdrive_mpc.models.checked_yaml import StrictModel
from diffdrive_mpc.models.named_file import EntryFile
from diffdrive_mpc.models.robot import Positive, Robot, load_robot
from diffdrive_mpc.sim.plants.base_commands import BaseCommands
from diffdrive_mpc.sim.plants.twin_parameters import Firmware, TwinParameters, load_firmware, load_twin_parameters
from diffdrive_mpc.sim.sensing.sensor_set import SensorSet, load_sensor_set

ROBOTS = EntryFile("robot", Path(__file__).with_name("robots.yaml"))
DEFAULT = "default"
"""Name of the default surface and sensor set, which the values of a robot file replace."""


class SimulatedRobot(StrictModel):
    """Parameters of a robot in the physics, with the keys and units of the files of the digital twin."""

    description: str = Field(min_length=1, description="description in one line")
    robot: Robot = Field(description="robot, as in models/parameters/robot.yaml")
    twin: TwinParameters = Field(description="physical parameters, as in sim/plants/parameters/twin.yaml")
    firmware: Firmware = Field(description="firmware, as in sim/plants/parameters/firmware.yaml")
    base: BaseCommands | None = Field(default=None, description="limits and wheel commands of the base")
    friction: Positive | None = Field(
        default=None, description="sliding friction coefficient of the default surface of the robot"
    )
    sensors: SensorSet = Field(description="default sensor set of the robot, as in sim/sensing/sensor_sets.yaml")
    parts: dict[str, Any] = Field(
        default_factory=dict, description="values for simulator parts of other packages, by name"
    )

    @model_validator(mode="after")
    def _check_weight(self) -> SimulatedRobot:
        chassis, robot = self.twin.chassis, self.robot
        if not robot.mass > 4 * chassis.wheel_mass:
            raise ValueError(
                f"robot.mass {robot.mass} kg: must exceed the mass of the wheels, {4 * chassis.wheel_mass:g} kg"
            )
        ahead, left = chassis.centre_of_mass
        middle = -chassis.wheel_base / 2 if chassis.castors else 0.0
        if not (abs(ahead - middle) < chassis.wheel_base / 2 and abs(left) < robot.track / 2):
            raise ValueError(
                f"twin.chassis.centre_of_mass [{ahead}, {left}] m: must lie between the wheels, "
                f"at most {chassis.wheel_base / 2:g} m ahead and {robot.track / 2:g} m to the left"
            )
        return self


def digital_twin() -> dict[str, object]:
    """Load the default values of robot files, which are those of the papers' robot."""
    parts = {
        "robot": load_robot(),
        "twin": load_twin_parameters(),
        "firmware": load_firmware(),
        "sensors": load_sensor_set(DEFAULT),
    }
    return {key: part.model_dump() for key, part in parts.items()}


def load_simulated_robot(name: str | Path) -> SimulatedRobot:
    """Read a robot by built-in name or path; missing values are those of the digital twin.

    Raises
    ------
    models.checked_yaml.ConfigError
        If the robot does not exist or its file is invalid.
    """
    return ROBOTS.load(SimulatedRobot, name, digital_twin())
