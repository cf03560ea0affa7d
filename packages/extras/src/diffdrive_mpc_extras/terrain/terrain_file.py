"""A terrain: its shear law and the slip law of a vehicle on it, as far as they are known."""

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
    """tau = p mu (1 - exp(-j / K)) under a tyre; Ordonez et al., 2017 (P4), equation 5."""

    mu_outer: Positive = Field(description="coefficient of friction under the wheels outside in the turn [-]")
    mu_inner: Positive = Field(description="under those inside [-]")
    modulus: Positive = Field(description="shear deformation modulus K [m]")


class Terrain(StrictModel):
    """A floor under a vehicle."""

    description: str = Field(min_length=1)
    shear: Shear | None = Field(default=None, description="without: not known")
    slip: tuple[Row, Row, Row] | None = Field(
        default=None,
        description="a11 to a33 of models.slip_laws.polynomial_twist, lateral to the left; without: what is in balance",
    )
    published_least_radius: Positive | None = Field(default=None, description="that the source found [m]")

    def known_shear(self) -> Shear:
        """Return the shear law; raise ConfigError if it is unknown."""
        if self.shear is None:
            raise ConfigError(
                f"terrain '{self.description}': its shear law is not known; "
                "give 'shear' with mu_outer, mu_inner and modulus"
            )
        return self.shear

    def yaw_rates(self, commands: FloatArray) -> FloatArray | None:
        """Compute yaw rates (n,) [rad/s] of the body under commands (n, 2), by the slip law; None without one."""
        return None if self.slip is None else polynomial_twist(self.slip, commands)[..., 2]


def load_terrain(name: str | Path) -> Terrain:
    """Read a terrain by shipped name ("vinyl", "asphalt", ...) or path; raises ConfigError on a mistake in it."""
    return load_checked(Terrain, named_file("terrain", TERRAINS, name))
