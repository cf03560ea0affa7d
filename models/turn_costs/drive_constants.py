"""Electrical power of the motors: Ordonez et al., 2017 (P4), equations 25 and 26.

P = torque times wheel speed + R_e i^2 with i = torque / (K_T g eta). As there, the gears' loss is in the current alone:
a motor that drives draws a little more than this, and one that brakes gives back a little less.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike
from pydantic import BeforeValidator, Field

from diffdrive_mpc.models.checked_yaml import StrictModel, load_checked
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.named_file import named_file
from diffdrive_mpc.models.robot import NotNegative, Positive, Share

DRIVES = Path(__file__).parent / "drives"


class DriveConstants(StrictModel):
    """Motors, gears and drivers of a robot, all motors alike."""

    name: str = Field(min_length=1)
    torque_constant: Positive = Field(description="K_T, of the motor before its gear [N m/A]")
    gear_ratio: Positive = Field(description="g [-]")
    gear_efficiency: Share = Field(description="eta [-]")
    resistance: NotNegative = Field(description="R_e of a motor with its leads and driver [ohm]")
    motors_per_side: int = Field(ge=1, description="they share the torque of the side")
    regeneration: bool = Field(description="whether a side that brakes gives its power to the battery; else it is lost")
    driver_efficiency: Share = Field(default=1.0, description="power of the motors over what their drivers draw [-]")
    idle_power: NotNegative = Field(default=0.0, description="of computer, sensors and drivers at rest [W]")
    provenance: str = Field(min_length=1, description="where these values come from")

    @property
    def torque_per_current(self) -> float:
        """K_T g eta: torque at the wheel over the current of its motor [N m/A]."""
        return self.torque_constant * self.gear_ratio * self.gear_efficiency

    @property
    def side_heating(self) -> float:
        """Power that heats the windings of a side over the square of its torque [W/(N m)^2]."""
        return self.resistance / self.motors_per_side / self.torque_per_current**2

    def side_power(self, torque: ArrayLike, speed: ArrayLike) -> FloatArray:
        """Electrical power of a side (...) [W] for its torque [N m] and the speed of its wheels [rad/s]."""
        torques = np.asarray(torque, dtype=float)
        return self._drawn(torques * np.asarray(speed, dtype=float) + self.side_heating * torques**2)

    def motor_power(self, power: ArrayLike, square: ArrayLike) -> FloatArray:
        """Electrical power of a motor (...) [W] for its mechanical power [W] and its squared torque [N^2 m^2]."""
        heating = self.resistance / self.torque_per_current**2
        return self._drawn(np.asarray(power, dtype=float) + heating * np.asarray(square, dtype=float))

    def robot_power(self, torque: FloatArray, speed: FloatArray) -> FloatArray:
        """(n,) what the robot takes from its battery [W] for torques (n, 2) and wheel speeds (n, 2) of the sides."""
        return np.asarray(self.side_power(torque, speed).sum(axis=-1) + self.idle_power)

    def _drawn(self, power: FloatArray) -> FloatArray:
        """What the drivers draw for the motors' power; a braking motor's passes them the other way."""
        given_back = power * self.driver_efficiency if self.regeneration else np.zeros_like(power)
        return np.where(power > 0, power / self.driver_efficiency, given_back)


def load_drive_constants(name: str | Path = "default") -> DriveConstants:
    """Read constants by shipped name ("default", "fsu_bot") or path; raises ConfigError on a mistake in the file."""
    return load_checked(DriveConstants, named_file("drive", DRIVES, name))


@cache
def papers_drive() -> DriveConstants:
    """Those of the papers' robot, of a robot that says nothing else."""
    return load_drive_constants()


def _by_name(data: object) -> object:
    return load_drive_constants(data) if isinstance(data, str) else data


NamedDrive = Annotated[DriveConstants, BeforeValidator(_by_name, json_schema_input_type=str | DriveConstants)]
"""Constants in a file of something else: written out, or the name of a shipped file."""
