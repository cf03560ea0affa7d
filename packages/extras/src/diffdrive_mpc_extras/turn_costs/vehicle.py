"""Vehicle data for shear and power: loads, dimensions, contact patches, motors and drivers."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Annotated, Self

import numpy as np
from numpy.typing import ArrayLike
from pydantic import BeforeValidator, Field, model_validator

from diffdrive_mpc.models.checked_yaml import StrictModel, load_checked
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.named_file import named_file
from diffdrive_mpc.models.robot import NotNegative, Positive, Share

VEHICLES = Path(__file__).parent / "vehicles"
GRAVITY = 9.81
"""Standard gravity [m/s^2], rounded as in the files."""


class Vehicle(StrictModel):
    """Four-wheel skid-steer vehicle with coupled wheels on each side.

    The frame has its origin at the centre of the wheels, x forward and y to the left.
    """

    name: str = Field(min_length=1)
    weight: Positive = Field(description="weight [N]")
    track: Positive = Field(description="distance between the wheels of an axle [m]")
    command_track: Positive | None = Field(
        default=None, description="track with which the base converts commands to wheel speeds [m]; null: the track"
    )
    wheel_base: Positive = Field(description="distance between the axles [m]")
    wheel_radius: Positive = Field(description="wheel radius [m]")
    patch_length: Positive = Field(description="length of the contact patch of a tyre [m]")
    patch_width: Positive = Field(description="width of the contact patch of a tyre [m]")
    centre_of_mass: tuple[float, float, NotNegative] = Field(
        description="position of the centre of mass: forward and left of the centre of the wheels, above the ground [m]"
    )
    torque_limit: Positive = Field(description="maximum torque of the motors of one side, at the wheels [N m]")
    drag_torque: NotNegative = Field(
        description="load-independent friction torque of the drive train of one side [N m]"
    )
    rolling_coefficient: NotNegative = Field(default=0.0, description="rolling resistance of the tyres over load [-]")
    provenance: str = Field(min_length=1, description="source of the values")

    @model_validator(mode="after")
    def _check_centre_of_mass(self) -> Self:
        x, y, _ = self.centre_of_mass
        if not (abs(x) < self.wheel_base / 2 and abs(y) < self.track / 2):
            raise ValueError(
                f"centre_of_mass [{x}, {y}] m: it must be between the wheels, at most {self.wheel_base / 2:g} m "
                f"forward and {self.track / 2:g} m to the left"
            )
        return self

    @property
    def wheel_positions(self) -> FloatArray:
        """Centres (4, 2) of the contact patches [m]: front left, front right, rear left, rear right."""
        x, y = self.wheel_base / 2, self.track / 2
        return np.array([(x, y), (x, -y), (-x, y), (-x, -y)])

    @property
    def mass(self) -> float:
        """Mass [kg]."""
        return self.weight / GRAVITY

    def rim_speeds(self, commands: FloatArray) -> FloatArray:
        """Compute rim speeds (n, 2) left, right [m/s] for commands (n, 2) v [m/s], omega [rad/s]."""
        half_track = 0.5 * (self.command_track or self.track)
        v, omega = np.moveaxis(commands, -1, 0)
        return np.stack([v - half_track * omega, v + half_track * omega], axis=-1)

    def loads(self, acceleration: FloatArray) -> FloatArray:
        """Compute the load of each wheel (n, 4) [N] under accelerations (n, 2) of the centre of mass [m/s^2].

        The model is a rigid body on four equal springs, so the loads are linear in the wheel position. The load of a
        wheel is clipped at zero; the sum of the loads then exceeds the weight.
        """
        ahead, left, height = self.centre_of_mass
        # Intersection of the resultant of weight and inertial force with the ground.
        pressure_centre = np.array([ahead, left]) - height / GRAVITY * acceleration
        x, y = self.wheel_positions.T
        share = 0.25 + pressure_centre[..., :1] * x / self.wheel_base**2 + pressure_centre[..., 1:] * y / self.track**2
        return np.asarray(self.weight * np.maximum(share, 0.0))


def load_vehicle(name: str | Path) -> Vehicle:
    """Read a vehicle by shipped name ("default", "fsu_bot") or path; raises ConfigError if the file is invalid."""
    return load_checked(Vehicle, named_file("vehicle", VEHICLES, name))


DRIVES = Path(__file__).parent / "drives"


class DriveConstants(StrictModel):
    """Constants of motors, gears and drivers; all motors of the robot are equal.

    Source of the power model: Ordonez et al., 2017 (P4), equations 25 and 26.
    """

    name: str = Field(min_length=1)
    torque_constant: Positive = Field(description="torque constant K_T of the motor without gear [N m/A]")
    gear_ratio: Positive = Field(description="gear ratio g [-]")
    gear_efficiency: Share = Field(description="gear efficiency eta [-]")
    resistance: NotNegative = Field(description="resistance R_e of a motor with its leads and driver [ohm]")
    motors_per_side: int = Field(ge=1, description="number of motors that share the torque of a side")
    regeneration: bool = Field(description="true if a braking side charges the battery; false: its power is lost")
    driver_efficiency: Share = Field(default=1.0, description="motor power over power drawn by the drivers [-]")
    idle_power: NotNegative = Field(default=0.0, description="power of computer, sensors and drivers at rest [W]")
    provenance: str = Field(min_length=1, description="source of the values")

    @property
    def torque_per_current(self) -> float:
        """Torque at the wheel over the current of its motor, K_T g eta [N m/A]."""
        return self.torque_constant * self.gear_ratio * self.gear_efficiency

    @property
    def side_heating(self) -> float:
        """Ohmic loss of the windings of a side over the square of its torque [W/(N m)^2]."""
        return self.resistance / self.motors_per_side / self.torque_per_current**2

    def side_power(self, torque: ArrayLike, speed: ArrayLike) -> FloatArray:
        """Compute the electrical power of a side (...) [W] for its torque [N m] and the speed of its wheels [rad/s]."""
        torques = np.asarray(torque, dtype=float)
        return self._battery_power(torques * np.asarray(speed, dtype=float) + self.side_heating * torques**2)

    def motor_power(self, power: ArrayLike, square: ArrayLike) -> FloatArray:
        """Compute a motor's electrical power (...) [W] for mechanical power [W] and squared torque [N^2 m^2]."""
        heating = self.resistance / self.torque_per_current**2
        return self._battery_power(np.asarray(power, dtype=float) + heating * np.asarray(square, dtype=float))

    def robot_power(self, torque: FloatArray, speed: FloatArray) -> FloatArray:
        """Compute the battery power (n,) [W] for torques (n, 2) and wheel speeds (n, 2) of the sides."""
        return np.asarray(self.side_power(torque, speed).sum(axis=-1) + self.idle_power)

    def _battery_power(self, power: FloatArray) -> FloatArray:
        """Compute the power from the battery for the electrical power of motors; it is negative while charging."""
        returned = power * self.driver_efficiency if self.regeneration else np.zeros_like(power)
        return np.where(power > 0, power / self.driver_efficiency, returned)


def load_drive_constants(name: str | Path = "default") -> DriveConstants:
    """Read constants by shipped name ("default", "fsu_bot") or path; raises ConfigError if the file is invalid."""
    return load_checked(DriveConstants, named_file("drive", DRIVES, name))


@cache
def papers_drive() -> DriveConstants:
    """Return the drive constants of the robot of the papers, the default."""
    return load_drive_constants()


def _load_if_name(data: object) -> object:
    return load_drive_constants(data) if isinstance(data, str) else data


NamedDrive = Annotated[DriveConstants, BeforeValidator(_load_if_name, json_schema_input_type=str | DriveConstants)]
"""Drive constants as a field of another file: a mapping, or the name of a drive file."""
