"""The vehicle as the shear under its tyres sees it: loads, lengths, contact patches."""

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
"""Standard gravity [m/s^2], rounded as the files take it."""


class Vehicle(StrictModel):
    """A skid-steer on four wheels, those of a side turning together; x is ahead and y to the left of the middle."""

    name: str = Field(min_length=1)
    weight: Positive = Field(description="weight [N]")
    track: Positive = Field(description="distance between the wheels of an axle [m]")
    command_track: Positive | None = Field(
        default=None, description="track by which the base turns commands into wheel speeds [m]; without: the track"
    )
    wheel_base: Positive = Field(description="distance between the axles [m]")
    wheel_radius: Positive = Field(description="wheel radius [m]")
    patch_length: Positive = Field(description="contact patch of a tyre along its rolling [m]")
    patch_width: Positive = Field(description="contact patch across it [m]")
    centre_of_mass: tuple[float, float, NotNegative] = Field(
        description="ahead of and to the left of the middle between the wheels, and above the floor [m]"
    )
    torque_limit: Positive = Field(description="largest torque of the motors of one side, at the wheels [N m]")
    drag_torque: NotNegative = Field(
        description="torque of one side against the friction of its drive train, whatever it carries [N m]"
    )
    rolling_coefficient: NotNegative = Field(default=0.0, description="rolling resistance of the tyres over load [-]")
    provenance: str = Field(min_length=1, description="where these values come from")

    @model_validator(mode="after")
    def _on_its_wheels(self) -> Self:
        ahead, left, _ = self.centre_of_mass
        if not (abs(ahead) < self.wheel_base / 2 and abs(left) < self.track / 2):
            raise ValueError(
                f"centre_of_mass [{ahead}, {left}] m: it must lie between the wheels, {self.wheel_base / 2:g} m ahead "
                f"and {self.track / 2:g} m to the left at most"
            )
        return self

    @property
    def places(self) -> FloatArray:
        """(4, 2) centres of the patches, ahead and left [m]: front left, front right, rear left, rear right."""
        ahead, left = self.wheel_base / 2, self.track / 2
        return np.array([(ahead, left), (ahead, -left), (-ahead, left), (-ahead, -left)])

    @property
    def mass(self) -> float:
        """Mass [kg]."""
        return self.weight / GRAVITY

    def rims(self, twist: FloatArray) -> FloatArray:
        """Compute rim speeds left, right (n, 2) [m/s] of the base for commands (n, 2) v [m/s], omega [rad/s]."""
        half = 0.5 * (self.command_track or self.track)
        v, omega = np.moveaxis(twist, -1, 0)
        return np.stack([v - half * omega, v + half * omega], axis=-1)

    def loads(self, acceleration: FloatArray) -> FloatArray:
        """Compute the load of each wheel (n, 4) [N] under accelerations (n, 2) of the centre of mass [m/s^2].

        A rigid body on four equal springs: the loads lie in a plane. A wheel that would lift carries nothing, and the
        others then carry more than the weight by its missing negative load.
        """
        ahead, left, height = self.centre_of_mass
        # Where the line of weight and inertia meets the floor.
        foot = np.array([ahead, left]) - height / GRAVITY * acceleration
        x, y = self.places.T
        share = 0.25 + foot[..., :1] * x / self.wheel_base**2 + foot[..., 1:] * y / self.track**2
        return np.asarray(self.weight * np.maximum(share, 0.0))


def load_vehicle(name: str | Path) -> Vehicle:
    """Read a vehicle by shipped name ("default", "fsu_bot") or path; raises ConfigError on a mistake in it."""
    return load_checked(Vehicle, named_file("vehicle", VEHICLES, name))


# Electrical power of the motors: Ordonez et al., 2017 (P4), equations 25 and 26.


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
        """Compute the electrical power of a side (...) [W] for its torque [N m] and the speed of its wheels [rad/s]."""
        torques = np.asarray(torque, dtype=float)
        return self._drawn(torques * np.asarray(speed, dtype=float) + self.side_heating * torques**2)

    def motor_power(self, power: ArrayLike, square: ArrayLike) -> FloatArray:
        """Compute a motor's electrical power (...) [W] for mechanical power [W] and squared torque [N^2 m^2]."""
        heating = self.resistance / self.torque_per_current**2
        return self._drawn(np.asarray(power, dtype=float) + heating * np.asarray(square, dtype=float))

    def robot_power(self, torque: FloatArray, speed: FloatArray) -> FloatArray:
        """Compute the battery power (n,) [W] for torques (n, 2) and wheel speeds (n, 2) of the sides."""
        return np.asarray(self.side_power(torque, speed).sum(axis=-1) + self.idle_power)

    def _drawn(self, power: FloatArray) -> FloatArray:
        """Compute the power drawn by the drivers; that of a braking motor flows the other way."""
        given_back = power * self.driver_efficiency if self.regeneration else np.zeros_like(power)
        return np.where(power > 0, power / self.driver_efficiency, given_back)


def load_drive_constants(name: str | Path = "default") -> DriveConstants:
    """Read constants by shipped name ("default", "fsu_bot") or path; raises ConfigError on a mistake in the file."""
    return load_checked(DriveConstants, named_file("drive", DRIVES, name))


@cache
def papers_drive() -> DriveConstants:
    """Return the drive of the papers' robot, the default."""
    return load_drive_constants()


def _by_name(data: object) -> object:
    return load_drive_constants(data) if isinstance(data, str) else data


NamedDrive = Annotated[DriveConstants, BeforeValidator(_by_name, json_schema_input_type=str | DriveConstants)]
"""Constants in a file of something else: written out, or the name of a shipped file."""
