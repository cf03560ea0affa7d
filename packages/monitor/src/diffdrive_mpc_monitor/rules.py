"""Schema of the monitor's rules file. Units are in brackets."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Self

from pydantic import Field, model_validator

from diffdrive_mpc.models.checked_yaml import StrictModel, load_checked
from diffdrive_mpc.models.named_file import named_file, shipped_names

FOLDER = Path(__file__).parent / "rules"
"""Folder of the shipped rules."""

Positive = Annotated[float, Field(gt=0, le=1000)]
NotNegative = Annotated[float, Field(ge=0, le=1000)]
Age = Annotated[float, Field(ge=0, le=60)]


class CommandRules(StrictModel):
    """Limits of commands, independent of the robot's motion."""

    v: Positive = Field(description="maximum |v| [m/s]")
    omega: Positive = Field(description="maximum |omega| [rad/s]")
    v_reverse: NotNegative = Field(0.0, description="maximum speed in reverse, if it differs from v; 0: v [m/s]")
    omega_right: NotNegative = Field(
        0.0, description="maximum yaw rate to the right, if it differs from omega; 0: omega [rad/s]"
    )
    v_slew: Positive = Field(description="maximum rate of change of v away from zero [m/s^2]")
    omega_slew: Positive = Field(description="maximum rate of change of omega away from zero [rad/s^2]")
    v_braking: Positive = Field(
        description="maximum rate of change of v towards zero; also the braking rate of the monitor [m/s^2]"
    )
    omega_braking: Positive = Field(
        description="maximum rate of change of omega towards zero; also the braking rate of the monitor [rad/s^2]"
    )
    jitter: Positive = Field(description="tolerated error in the timing of commands, for the slew check [s]")
    silence: Positive = Field(description="maximum time without a command while the last command moves the robot [s]")
    slowest: Positive = Field(description="maximum mean interval between commands while the robot moves [s]")
    quickest: Positive = Field(description="minimum mean interval between commands [s]")
    oldest: Positive = Field(description="maximum age of a command that moves the robot, by its stamp [s]")
    stop_within: Positive = Field(
        description="time for commands to become zero after the controller reports standstill [s]"
    )
    standing_v: Positive = Field(description="maximum speed of a command or motion that counts as standstill [m/s]")
    standing_omega: Positive = Field(
        description="maximum yaw rate of a command or motion that counts as standstill [rad/s]"
    )
    rest_distance: Positive = Field(
        0.05, description="maximum distance that the wheels move after the controller reports standstill [m]"
    )
    rest_turn: Positive = Field(
        0.2, description="maximum angle by which the wheels turn the robot after that report [rad]"
    )

    @model_validator(mode="after")
    def _check_intervals(self) -> Self:
        if self.quickest >= self.slowest:
            raise ValueError("commands.quickest must be shorter than commands.slowest")
        return self


class OnPath(StrictModel):
    """Bounds of the robot's pose relative to the path section around the present reference."""

    distance: Positive = Field(description="maximum distance from the path section around the reference [m]")
    lasting: NotNegative = Field(description="maximum time for which the distance may be exceeded [s]")
    far: Positive = Field(description="maximum distance of the pose at rest after braking now [m]")
    reaction: NotNegative = Field(description="delay until braking begins [s]")
    heading: Positive = Field(description="maximum angle to the headings of the path section [rad]")
    far_lasting: NotNegative = Field(description="maximum time for which `far` or `heading` may be exceeded [s]")
    late: NotNegative = Field(description="start of the path section, as a time before the present reference [s]")
    early: NotNegative = Field(description="end of the path section, as a time after the present reference [s]")
    grace: Positive = Field(
        description="maximum time of motion without a reference, or while the controller reports standstill [s]"
    )


class Returning(StrictModel):
    """Bounds for a robot that returns to its path after an external motion, a standstill or a new reference."""

    within: NotNegative = Field(description="maximum time away from the path section while returning [s]")
    distance: Positive = Field(
        description="maximum distance of the pose at rest after braking now, while returning [m]"
    )
    late: NotNegative = Field(
        description="start of the path section while returning, as a time before the present reference [s]"
    )
    early: NotNegative = Field(
        description="end of the path section while returning, as a time after the present reference [s]"
    )


class SensorAges(StrictModel):
    """Maximum ages of sensor data while the robot moves."""

    odometry_age: Annotated[float, Field(gt=0, le=60)] = Field(description="maximum age of the odometry [s]")
    pose_age: Age = Field(
        description="maximum age of the pose; 0: no pose sensor, the pose of the odometry is used [s]"
    )
    gyro_age: Age = Field(description="maximum age of the yaw rate; 0: no gyro, the wheels measure the yaw rate [s]")
    ahead: Positive = Field(description="maximum time by which a stamp may be in the future [s]")


class Agreement(StrictModel):
    """Maximum differences between sensors."""

    window: Annotated[float, Field(gt=0, le=4)] = Field(description="time over which sensors are compared [s]")
    blend: Positive = Field(
        description="time constant with which poses correct the pose predicted by wheels and gyro [s]"
    )
    distance: Positive = Field(description="maximum difference between poses and wheels within the window [m]")
    distance_share: NotNegative = Field(description="additional difference per distance driven [m/m]")
    turn: Positive = Field(
        description="maximum difference in heading of poses and gyro (no gyro: wheels) within the window [rad]"
    )
    gyro_gain: Positive = Field(description="maximum ratio of the yaw rate of the gyro to that of the wheels [-]")
    gyro_least: NotNegative = Field(description="minimum ratio of these yaw rates [-]")
    gyro_turn: Positive = Field(description="tolerance of the turn over the window [rad]")
    lasting: NotNegative = Field(description="maximum time for which sensors may contradict each other [s]")


class ResponseBounds(StrictModel):
    """Bounds of the response to commands: first order with dead time."""

    dead_time: Annotated[float, Field(gt=0, le=2)] = Field(description="maximum delay until a command acts [s]")
    lag_v: Positive = Field(description="maximum time constant with which v follows [s]")
    lag_omega: Positive = Field(description="maximum time constant with which omega follows [s]")
    gain_v: Positive = Field(description="maximum ratio of v to its command [-]")
    gain_omega: Positive = Field(description="maximum ratio of omega to its command [-]")
    margin_v: Positive = Field(description="tolerance of the bounds of v [m/s]")
    margin_omega: Positive = Field(description="tolerance of the bounds of omega [rad/s]")
    lasting: NotNegative = Field(description="maximum time for which the robot may be outside the bounds [s]")


class Rules(StrictModel):
    """Rules of the monitor for one robot."""

    name: str = Field("", max_length=80, description="name of the robot")
    commands: CommandRules = Field(description="limits of commands")
    path: OnPath = Field(description="bounds of the pose")
    returning: Returning = Field(description="bounds of the pose while the robot returns to its path")
    sensors: SensorAges = Field(description="maximum ages of sensors")
    agreement: Agreement = Field(description="maximum differences between sensors")
    answer: ResponseBounds = Field(description="bounds of the response to commands")

    def with_sensors(self, *, pose: bool, gyro: bool) -> Self:
        """Return the rules for a robot that may lack a pose sensor or a gyro."""
        missing = {name: 0.0 for name, present in (("pose_age", pose), ("gyro_age", gyro)) if not present}
        return self.model_copy(update={"sensors": self.sensors.model_copy(update=missing)})

    @property
    def numbers(self) -> dict[str, float]:
        """All values by the name of the field in C (group and key)."""
        groups = (group for group in type(self).model_fields if group != "name")
        return {f"{group}_{key}": float(value) for group in groups for key, value in getattr(self, group)}


def load_rules(name: str | Path = "default") -> Rules:
    """Read rules by the name of shipped rules or the path of a file.

    Raises
    ------
    models.checked_yaml.ConfigError
        If there is no such file, or a value is missing, unknown or out of range.
    """
    return load_checked(Rules, named_file("rules", FOLDER, name, shipped_names(FOLDER)))
