"""Terrain file: shear law of the ground and slip law of a vehicle on it, both optional."""

from __future__ import annotations

from pathlib import Path

from pydantic import Field

from diffdrive_mpc.models.checked_yaml import ConfigError, StrictModel, load_checked
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.named_file import named_file
from diffdrive_mpc.models.robot import Positive
from diffdrive_mpc.models.slip_laws import polynomial_twist

TERRAINS = Path(__file__).parent / "terrains"
Row = tuple[float, float, float]


class Shear(StrictModel):
    """Shear law tau = p mu (1 - exp(-j / K)) under a tyre; Ordonez et al., 2017 (P4), equation 5."""

    mu_outer: Positive = Field(description="coefficient of friction under the outer wheels of a turn [-]")
    mu_inner: Positive = Field(description="coefficient of friction under the inner wheels of a turn [-]")
    modulus: Positive = Field(description="shear deformation modulus K [m]")


class Terrain(StrictModel):
    """Ground under a vehicle."""

    description: str = Field(min_length=1)
    shear: Shear | None = Field(default=None, description="shear law; null: unknown")
    slip: tuple[Row, Row, Row] | None = Field(
        default=None,
        description="slip law: a11 to a33 of models.slip_laws.polynomial_twist, lateral to the left; null: the yaw "
        "rate follows from the balance of moments",
    )
    published_least_radius: Positive | None = Field(default=None, description="least radius of the source [m]")

    def known_shear(self) -> Shear:
        """Return the shear law; raise ConfigError if it is unknown."""
        if self.shear is None:
            raise ConfigError(
                f"terrain '{self.description}': its shear law is unknown; add 'shear' with mu_outer, mu_inner, modulus"
            )
        return self.shear

    def yaw_rates(self, commands: FloatArray) -> FloatArray | None:
        """Compute yaw rates (n,) [rad/s] of the body for commands (n, 2) by the slip law; None without a slip law."""
        return None if self.slip is None else polynomial_twist(self.slip, commands)[..., 2]


def load_terrain(name: str | Path) -> Terrain:
    """Read a terrain by shipped name ("vinyl", "asphalt", ...) or path; raises ConfigError if the file is invalid."""
    return load_checked(Terrain, named_file("terrain", TERRAINS, name))
