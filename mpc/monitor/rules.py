"""The rules of the monitor: one typed schema of the file that holds them. Units stand in brackets."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Self

from pydantic import Field, model_validator

from diffdrive_mpc.models.checked_yaml import StrictModel, load_checked
from diffdrive_mpc.models.named_file import named_file, shipped_names

FOLDER = Path(__file__).parent / "rules"
"""Folder of the rules that ship."""

Positive = Annotated[float, Field(gt=0, le=1000)]
NotNegative = Annotated[float, Field(ge=0, le=1000)]
Age = Annotated[float, Field(ge=0, le=60)]


class CommandRules(StrictModel):
    """What commands may be, whatever the robot does."""

    v: Positive = Field(description="largest |v| [m/s]")
    omega: Positive = Field(description="largest |omega| [rad/s]")
    v_slew: Positive = Field(description="fastest change of v away from zero [m/s^2]")
    omega_slew: Positive = Field(description="fastest change of omega away from zero [rad/s^2]")
    v_braking: Positive = Field(description="fastest change of v towards zero, and at which the monitor brakes [m/s^2]")
    omega_braking: Positive = Field(
        description="fastest change of omega towards zero, and at which the monitor brakes [rad/s^2]"
    )
    jitter: Positive = Field(description="by so much time commands may come too early or too late for their slew [s]")
    silence: Positive = Field(description="longest time without a command after one that moves the robot [s]")
    slowest: Positive = Field(description="longest mean time between commands while the robot is moved [s]")
    quickest: Positive = Field(description="shortest mean time between commands [s]")
    oldest: Positive = Field(description="oldest stamp of a command that moves the robot [s]")
    stop_within: Positive = Field(description="after a controller says that it stands, commands have to be zero [s]")
    standing_v: Positive = Field(description="a command or a motion up to this stands [m/s]")
    standing_omega: Positive = Field(description="a command or a motion up to this stands [rad/s]")

    @model_validator(mode="after")
    def _paces_in_order(self) -> Self:
        if self.quickest >= self.slowest:
            raise ValueError("commands.quickest has to be shorter than commands.slowest")
        return self


class OnPath(StrictModel):
    """Where the robot may be: near the stretch of path that the reference covers around now."""

    distance: Positive = Field(description="farthest from the stretch [m]")
    lasting: NotNegative = Field(description="the robot may be further away for so long [s]")
    far: Positive = Field(description="farthest from the stretch, if the robot braked now [m]")
    reaction: NotNegative = Field(description="braking begins so late [s]")
    heading: Positive = Field(description="farthest from the headings there [rad]")
    far_lasting: NotNegative = Field(description="either may be too large for so long [s]")
    late: NotNegative = Field(description="the stretch begins where the reference was so long ago [s]")
    early: NotNegative = Field(description="and ends where it will be so much later [s]")
    grace: Positive = Field(
        description="without a reference, or while the controller says that it stands, a robot may be moved so long [s]"
    )


class Returning(StrictModel):
    """Where a robot may be that something else moved off its path, or whose reference begins elsewhere."""

    within: NotNegative = Field(description="it has so long to be back on the stretch [s]")
    distance: Positive = Field(description="farthest from the stretch meanwhile, if it braked now [m]")
    late: NotNegative = Field(description="the stretch begins where the reference was so long ago meanwhile [s]")
    early: NotNegative = Field(description="and ends where it will be so much later [s]")


class SensorAges(StrictModel):
    """How old sensors may be while the robot is moved."""

    odometry_age: Annotated[float, Field(gt=0, le=60)] = Field(description="oldest odometry [s]")
    pose_age: Age = Field(description="oldest pose; 0: there is no pose sensor, and the pose of odometry counts [s]")
    gyro_age: Age = Field(description="oldest yaw rate; 0: there is no gyro, and wheels alone tell how it turns [s]")
    ahead: Positive = Field(description="stamps may be in the future by so much [s]")


class Agreement(StrictModel):
    """How far sensors may contradict each other."""

    window: Annotated[float, Field(gt=0, le=4)] = Field(description="they are compared over so long [s]")
    blend: Positive = Field(description="poses correct what wheels and gyro sum up over so long [s]")
    distance: Positive = Field(description="poses against wheels: difference within the window [m]")
    distance_share: NotNegative = Field(description="and in addition by the distance [m/m]")
    turn: Positive = Field(description="poses against gyro, else wheels: difference within the window [rad]")
    gyro_gain: Positive = Field(description="most that the body turns for what the wheels do [-]")
    gyro_least: NotNegative = Field(description="and least [-]")
    gyro_turn: Positive = Field(description="and by so much more or less over the window [rad]")
    lasting: NotNegative = Field(description="they may contradict each other for so long [s]")


class ResponseBounds(StrictModel):
    """How the robot answers to commands: first order with dead time, between bounds."""

    dead_time: Annotated[float, Field(gt=0, le=2)] = Field(description="longest until a command acts [s]")
    lag_v: Positive = Field(description="slowest time constant with which v follows [s]")
    lag_omega: Positive = Field(description="slowest time constant with which omega follows [s]")
    gain_v: Positive = Field(description="most that the robot drives for what is commanded [-]")
    gain_omega: Positive = Field(description="most that the robot turns for what is commanded [-]")
    margin_v: Positive = Field(description="and by so much faster or slower [m/s]")
    margin_omega: Positive = Field(description="and by so much faster or slower [rad/s]")
    lasting: NotNegative = Field(description="it may be outside for so long [s]")


class Rules(StrictModel):
    """What has to hold while a controller drives a robot."""

    name: str = Field("", max_length=80, description="for whom they are")
    commands: CommandRules = Field(description="what commands may be")
    path: OnPath = Field(description="where the robot may be")
    returning: Returning = Field(description="and where, if something else moved it")
    sensors: SensorAges = Field(description="how old sensors may be")
    agreement: Agreement = Field(description="how far sensors may contradict each other")
    answer: ResponseBounds = Field(description="how the robot answers to commands")

    def with_sensors(self, *, pose: bool, gyro: bool) -> Self:
        """The same for a robot that may have no pose sensor or no gyro."""
        absent = {name: 0.0 for name, there in (("pose_age", pose), ("gyro_age", gyro)) if not there}
        return self.model_copy(update={"sensors": self.sensors.model_copy(update=absent)})

    @property
    def numbers(self) -> dict[str, float]:
        """Every number by the name of its field in C: group and key."""
        groups = (group for group in type(self).model_fields if group != "name")
        return {f"{group}_{key}": float(value) for group in groups for key, value in getattr(self, group)}


def load_rules(name: str | Path = "default") -> Rules:
    """Read rules: the name of those that ship, or the path of a file.

    Raises
    ------
    models.checked_yaml.ConfigError
        If there are none, or a value is missing, unknown or out of range.
    """
    return load_checked(Rules, named_file("rules", FOLDER, name, shipped_names(FOLDER)))
