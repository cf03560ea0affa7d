"""The vehicle as the shear under its tyres sees it: loads, lengths, contact patches."""

from __future__ import annotations

from pathlib import Path
from typing import Self

import numpy as np
from pydantic import Field, model_validator

from diffdrive_mpc.models.checked_yaml import StrictModel, load_checked
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.named_file import named_file
from diffdrive_mpc.models.robot import NotNegative, Positive

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
        """(n, 2) rim speeds left, right [m/s] that the base makes of commands (n, 2) v [m/s], omega [rad/s]."""
        half = 0.5 * (self.command_track or self.track)
        v, omega = np.moveaxis(twist, -1, 0)
        return np.stack([v - half * omega, v + half * omega], axis=-1)

    def loads(self, acceleration: FloatArray) -> FloatArray:
        """(n, 4) load of each wheel [N] under accelerations (n, 2) of the centre of mass, ahead and left [m/s^2].

        A rigid body on four equal springs: the loads lie in a plane. A wheel that would lift carries nothing, and the
        others then carry more than the weight by what it would pull.
        """
        ahead, left, height = self.centre_of_mass
        # Where the line of weight and inertia meets the floor.
        foot = np.array([ahead, left]) - height / GRAVITY * acceleration
        x, y = self.places.T
        share = 0.25 + foot[..., :1] * x / self.wheel_base**2 + foot[..., 1:] * y / self.track**2
        return np.asarray(self.weight * np.maximum(share, 0.0))

    def carrying(self, mass: float, height: float | None = None) -> Vehicle:
        """The vehicle with a payload of `mass` [kg] above its centre of mass, at `height` [m] or as high as that."""
        ahead, left, own = self.centre_of_mass
        weight = self.weight + GRAVITY * mass
        high = own if height is None else (self.weight * own + GRAVITY * mass * height) / weight
        return self.model_copy(update={"weight": weight, "centre_of_mass": (ahead, left, high)})


def load_vehicle(name: str | Path) -> Vehicle:
    """Read a vehicle by shipped name ("default", "fsu_bot") or path; raises ConfigError on a mistake in it."""
    return load_checked(Vehicle, named_file("vehicle", VEHICLES, name))
