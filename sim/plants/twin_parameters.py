"""Parameters of the digital twin: chassis, tyres, motors, drivers, link and firmware."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

from pydantic import Field

from diffdrive_mpc.models.checked_yaml import StrictModel, load_checked
from diffdrive_mpc.models.robot import NotNegative, Positive

PARAMETERS = Path(__file__).parent / "parameters"
FIRMWARE_FILE = PARAMETERS / "firmware.yaml"


class ChassisParameters(StrictModel):
    """Rigid body and wheels, in addition to the robot file."""

    wheel_base: Positive = Field(description="distance between front and rear axle [m]")
    body_size: tuple[Positive, Positive, Positive] = Field(description="length, width, height of the body [m]")
    body_height: float = Field(description="height of the centre of the body above the axles [m]")
    wheel_mass: Positive = Field(description="mass of a wheel [kg]")
    centre_of_mass: tuple[float, float] = Field(
        description="centre of mass of the robot, ahead and to the left of the centre between the wheels [m]"
    )
    rolling_radii: tuple[Positive, Positive] = Field(
        default=(1.0, 1.0),
        description="ratio of the true radius of left and right wheels to the radius in firmware and encoders [-]",
    )
    castors: bool = Field(
        default=False,
        description="true for rear castors, which carry load without lateral force; the front axle is then at the "
        "origin of the body frame, which is the centre of rotation",
    )
    wheel_drag: NotNegative = Field(
        default=0.0, description="speed-independent friction torque of the drive train of each wheel [N m]"
    )


class Tyre(StrictModel):
    """MuJoCo contact parameters of a tyre and the surface."""

    contact_time: Positive = Field(description="time constant normal to the surface [s]")
    contact_damping: Positive = Field(description="damping ratio normal to the surface [-]")
    impedance: float = Field(gt=0, lt=1, description="share of the constraint that is enforced immediately [-]")
    creep_time: Positive = Field(description="time constant along the surface [s]")
    creep_stiffness: Positive = Field(description="ratio of tangential to normal stiffness [-]")


class Motor(StrictModel):
    """DC gear motor, whose torque falls linearly with speed."""

    stall_torque: Positive = Field(description="torque at standstill and full duty [N m]")
    no_load_speed: Positive = Field(description="speed without load at full duty [rad/s]")
    rotor_inertia: Positive = Field(description="inertia of rotor and gear at the output shaft [kg m^2]")
    spread: tuple[Positive, Positive, Positive, Positive] = Field(
        description="ratio of the torque of each motor to the nominal torque [-]"
    )


class Driver(StrictModel):
    """Velocity loop of a motor driver."""

    proportional_gain: NotNegative = Field(description="duty per speed error [s/rad]")
    integral_gain: NotNegative = Field(description="duty per angle error [1/rad]")
    observer_bandwidth: Positive = Field(description="absolute value of the double pole of the speed observer [rad/s]")
    torque_limit: Positive | None = Field(
        default=None, description="maximum motor torque due to the driver's current limit [N m]; default: unlimited"
    )


class Link(StrictModel):
    """Serial link from onboard computer to motor drivers."""

    dead_time: NotNegative = Field(description="time from sending a command to its effect [s]")


class TwinParameters(StrictModel):
    """Physical parameters in addition to the robot file."""

    substeps: int = Field(ge=1, description="number of physics steps per control sample")
    chassis: ChassisParameters
    tyre: Tyre
    motor: Motor
    driver: Driver
    link: Link


class Firmware(StrictModel):
    """Calibrated parameters of the firmware: command shaping and conversion to wheel speeds."""

    gain_v: Positive = Field(description="ratio of forward set-point to command")
    lag_v: Positive = Field(description="time constant of the forward filter [s]")
    lag_omega: Positive = Field(description="time constant of the yaw filter [s]")
    track: Positive = Field(description="track that converts yaw rate to wheel speeds [m]")
    provenance: dict[str, Any] = Field(description="origin of the values")


@cache
def load_twin_parameters() -> TwinParameters:
    """Read the parameter file of the digital twin; raise ConfigError if it is invalid."""
    return load_checked(TwinParameters, PARAMETERS / "twin.yaml")


def load_firmware(path: str | Path = FIRMWARE_FILE) -> Firmware:
    """Read firmware parameters; raise ConfigError if the file is invalid."""
    return load_checked(Firmware, path)
