"""Typed parameters of the digital twin: chassis, tyres, motors, drivers, link and firmware."""

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
    body_height: float = Field(description="centre of the body above the axles [m]")
    wheel_mass: Positive = Field(description="mass of one wheel [kg]")
    centre_of_mass: tuple[float, float] = Field(
        description="of the whole robot, ahead and to the left of the middle between the wheels [m]"
    )
    rolling_radii: tuple[Positive, Positive] = Field(
        default=(1.0, 1.0),
        description="of the left, of the right wheels over what firmware and encoders take",
    )
    castors: bool = Field(
        default=False,
        description="whether the rear wheels are castors, which carry load and hold nothing; the front axle then lies "
        "below the middle of the frame, where two driven wheels turn the robot about",
    )
    wheel_drag: NotNegative = Field(
        default=0.0,
        description="torque of each wheel against the friction of its drive train, whatever its speed [N m]",
    )


class Tyre(StrictModel):
    """Contact of a tyre with the floor, in MuJoCo's terms."""

    contact_time: Positive = Field(description="time constant normal to the floor [s]")
    contact_damping: Positive = Field(description="damping ratio normal to the floor")
    impedance: float = Field(gt=0, lt=1, description="share of the constraint that is enforced at once")
    creep_time: Positive = Field(description="time constant along the floor [s]")
    creep_stiffness: Positive = Field(description="stiffness along the floor over that normal to it")


class Motor(StrictModel):
    """DC gear motor: torque falls linearly with speed."""

    stall_torque: Positive = Field(description="torque at standstill and full duty [N m]")
    no_load_speed: Positive = Field(description="speed without load at full duty [rad/s]")
    rotor_inertia: Positive = Field(description="inertia of rotor and gear at the output shaft [kg m^2]")
    spread: tuple[Positive, Positive, Positive, Positive] = Field(description="torque of each motor over nominal")


class Driver(StrictModel):
    """Velocity loop of a motor driver."""

    proportional_gain: NotNegative = Field(description="duty per speed error [s/rad]")
    integral_gain: NotNegative = Field(description="duty per angle error [1/rad]")
    observer_bandwidth: Positive = Field(description="double pole of the speed observer [rad/s]")
    torque_limit: Positive | None = Field(
        default=None, description="largest torque of a motor by the driver's limit of its current [N m]; without: none"
    )


class Link(StrictModel):
    """Serial link from onboard computer to motor drivers."""

    dead_time: NotNegative = Field(description="from sending to acting [s]")


class TwinParameters(StrictModel):
    """Everything physical that the robot file does not hold."""

    substeps: int = Field(ge=1, description="physics steps per control sample")
    chassis: ChassisParameters
    tyre: Tyre
    motor: Motor
    driver: Driver
    link: Link


class Firmware(StrictModel):
    """Command shaping and conversion to wheel speeds in the microcontroller: the calibrated parameters."""

    gain_v: Positive = Field(description="forward set-point over command")
    lag_v: Positive = Field(description="time constant of the forward filter [s]")
    lag_omega: Positive = Field(description="time constant of the yaw filter [s]")
    track: Positive = Field(description="track that converts yaw rate into wheel speeds [m]")
    provenance: dict[str, Any] = Field(description="how these values were found")


@cache
def load_twin_parameters() -> TwinParameters:
    """Read the digital twin's parameter file; raises ConfigError on a mistake in it."""
    return load_checked(TwinParameters, PARAMETERS / "twin.yaml")


def load_firmware(path: str | Path = FIRMWARE_FILE) -> Firmware:
    """Read firmware parameters; raises ConfigError on a mistake in the file."""
    return load_checked(Firmware, path)
