"""Parameters of a robot, read from a file: geometry, mass, encoder and limits."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Annotated

from pydantic import Field

from diffdrive_mpc.models.checked_yaml import StrictModel, load_checked

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Share = Annotated[float, Field(gt=0, le=1)]
"""Share of a whole, above 0 and at most 1."""
SampleTime = Annotated[float, Field(ge=0.001, le=0.5)]
"""Time between two ticks of a controller [s]."""


class TwistBounds(StrictModel):
    """One positive bound for each channel of a twist."""

    v: Positive = Field(description="bound of the forward channel, SI units")
    omega: Positive = Field(description="bound of the yaw channel, SI units")


class RobotLimits(TwistBounds):
    """Maximum commanded speeds of the robot."""

    wheel_speed: Positive = Field(description="wheel speed without load [rad/s]")


class ReferenceAcceleration(TwistBounds):
    """Acceleration limits of a reference."""

    lateral: Positive = Field(description="bound of v omega for smoothly timed paths [m/s^2]")


class Robot(StrictModel):
    """Geometry, mass, encoder and limits of one robot."""

    name: str
    sample_time: Positive = Field(description="sampling time of the command loop [s]")
    wheel_radius: Positive = Field(description="wheel radius [m]")
    track: Positive = Field(description="geometric track [m]")
    mass: Positive = Field(description="mass [kg]")
    encoder_pulses: Positive = Field(description="encoder pulses per revolution of the output shaft")
    limits: RobotLimits
    reference_acceleration: ReferenceAcceleration
    command_slew: TwistBounds


@cache
def load_robot(path: str | Path | None = None) -> Robot:
    """Read a robot parameter file; by default that of the robot of the papers.

    Raises
    ------
    models.checked_yaml.ConfigError
        If the file cannot be read, or a value is missing, unknown or out of range.
    """
    return load_checked(Robot, path or Path(__file__).parent / "parameters" / "robot.yaml")
