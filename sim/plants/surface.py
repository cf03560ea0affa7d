"""What the robot drives on: friction for the physics, slip for velocity models."""

from __future__ import annotations

from pathlib import Path

from pydantic import Field, model_validator

from diffdrive_mpc.models.checked_yaml import StrictModel, load_checked
from diffdrive_mpc.models.named_file import named_file
from diffdrive_mpc.models.robot import NotNegative, Positive

SURFACES = Path(__file__).parent / "surfaces"


class Slip(StrictModel):
    """How the body moves when a velocity model says (v, omega)."""

    yaw_gain: Positive = Field(description="true yaw rate over that of the velocity model")
    wheel_yaw_gain: Positive = Field(description="true yaw rate over that of encoders and geometric track")
    longitudinal_gain: Positive = Field(description="true forward speed over that of the encoders")
    side_slip: NotNegative = Field(description="lateral speed, outward, over v * omega [s]")


class Surface(StrictModel):
    """One floor."""

    friction: Positive | None = Field(default=None, description="sliding friction coefficient of tyre on floor")
    sideways_friction: Positive | None = Field(
        default=None, description="that coefficient across the rolling direction, where it is another one"
    )
    slip: Slip = Field(description="slip of a plant that is a velocity model")

    @model_validator(mode="after")
    def _both_ways(self) -> Surface:
        if self.sideways_friction is not None and self.friction is None:
            raise ValueError("sideways_friction: give friction, along the rolling direction, too")
        return self

    @property
    def sideways(self) -> float:
        """Sliding friction across the rolling direction over that along it; 1 where both are the same."""
        return (
            1.0 if self.friction is None or self.sideways_friction is None else self.sideways_friction / self.friction
        )


def load_surface(name: str | Path) -> Surface:
    """Read a surface by shipped name or path.

    Raises
    ------
    models.checked_yaml.ConfigError
        If there is no such surface or its file has a mistake.
    """
    return load_checked(Surface, named_file("surface", SURFACES, name))
