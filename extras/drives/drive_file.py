"""Parameter files of drive models."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from diffdrive_mpc.extras.drives.drive_model import DriveModel, drive_model
from diffdrive_mpc.extras.drives.equations import wheel_response
from diffdrive_mpc.models.checked_yaml import StrictModel, check
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.robot import NotNegative, Positive
from diffdrive_mpc.models.structures.model_file import FunctionFile, write_parameters

_HEAD = "A drive model: dead time in samples, slopes [m/s^2, rad/s^2], times [s], SI units elsewhere."
Samples = Annotated[int, Field(ge=0, le=100)]


class DriveChannel(StrictModel):
    """What both models say of a channel; lengths in m for v, angles in rad for omega."""

    gain: Positive = Field(description="speed over reference; the paper has none [-]")
    dead_samples: Samples = Field(description="dead time in samples [-]")
    quicker: Positive = Field(description="largest slope when speeding up [m/s^2 or rad/s^2]")
    slower: Positive = Field(description="largest slope when slowing down [m/s^2 or rad/s^2]")
    still: Positive = Field(description="speed below which the robot stands; kinks are rounded over as much")


class ExperimentalChannel(DriveChannel):
    """A channel of the experimental model."""

    lag: Positive = Field(description="first-order lag [s]")
    threshold: NotNegative = Field(description="of the reference after a change of direction, at slope zero")
    threshold_by_slope: NotNegative = Field(description="its growth with the slope of the reference [s]")


class Chassis(StrictModel):
    """Equations 16 and 17."""

    mass: Positive = Field(description="m [kg]")
    wheel_radius: Positive = Field(description="r [m]")
    track: Positive = Field(description="b [m]")
    centre_ahead: float = Field(ge=-100, le=100, description="d, centre of mass ahead of the axle [m]")
    yaw_inertia: Positive = Field(description="I_A [kg m^2]")
    wheel_inertia: NotNegative = Field(description="I_0, of a wheel with its rotor [kg m^2]")

    @property
    def own(self) -> float:
        """A of equation 16 [kg m^2]."""
        return self._forward + self._turning + self.wheel_inertia

    @property
    def other(self) -> float:
        """B of equation 17 [kg m^2]."""
        return self._forward - self._turning

    @property
    def _forward(self) -> float:
        return self.mass * self.wheel_radius**2 / 4

    @property
    def _turning(self) -> float:
        return (self.yaw_inertia + self.mass * self.centre_ahead**2) * self.wheel_radius**2 / self.track**2


class WheelDrive(StrictModel):
    """PI control of a wheel's speed, and its actuator."""

    proportional_gain: Positive = Field(description="torque per error, K_R with motor and gear [N m s/rad]")
    integral_time: Positive = Field(description="T_I [s]")
    actuator_lag: Positive = Field(description="T_A [s]")
    friction: NotNegative = Field(description="K, viscous [N m s/rad]")


class ExperimentalFile(FunctionFile):
    """The parameter file of an experimental drive model."""

    structure: Literal["drive_experimental"]
    v: ExperimentalChannel
    omega: ExperimentalChannel

    def coefficients(self) -> list[FloatArray]:
        """What the steps of both channels take."""
        return [
            np.array([one.gain, one.quicker, one.slower, one.lag, one.threshold, one.threshold_by_slope])
            for one in (self.v, self.omega)
        ]


class PhysicalFile(FunctionFile):
    """The parameter file of a physical drive model."""

    structure: Literal["drive_physical"]
    chassis: Chassis
    wheel_drive: WheelDrive
    v: DriveChannel
    omega: DriveChannel

    def coefficients(self) -> list[FloatArray]:
        """What the steps of both channels take."""
        drive, own, other = self.wheel_drive, self.chassis.own, self.chassis.other
        return [
            np.concatenate(
                [
                    [one.gain, one.quicker, one.slower],
                    wheel_response(
                        drive.proportional_gain / inertia,
                        drive.friction / inertia,
                        drive.integral_time,
                        drive.actuator_lag,
                        self.sample_time,
                    ).T.ravel(),
                ]
            )
            for one, inertia in ((self.v, own + other), (self.omega, own - other))
        ]


DRIVE_FILES: dict[str, type[ExperimentalFile] | type[PhysicalFile]] = {
    "drive_experimental": ExperimentalFile,
    "drive_physical": PhysicalFile,
}
"""By the structure that a file names."""


def load_drive(path: Path, data: Any) -> DriveModel:  # noqa: ANN401 - what a YAML file may hold
    """The model of the parameter file at `path`, whose content is `data`.

    Raises
    ------
    models.checked_yaml.ConfigError
        If the file has a mistake.
    models.velocity_model.ModelError
        If it cannot be a robot's.
    """
    return drive_of(check(DRIVE_FILES[data["structure"]], data, str(path)))


def drive_of(content: ExperimentalFile | PhysicalFile) -> DriveModel:
    """The model that a parameter file describes; raises ModelError if it cannot be a robot's."""
    channels: tuple[DriveChannel, DriveChannel] = (content.v, content.omega)
    return drive_model(
        content.name,
        content.structure,
        content.sample_time,
        [one.dead_samples for one in channels],
        [one.still for one in channels],
        content.coefficients(),
        content.origins,
    )


def write_drive(path: Path, content: ExperimentalFile | PhysicalFile) -> None:
    """Write a parameter file; raises OSError where that cannot be done."""
    write_parameters(path, _HEAD, content)
