"""The rules of the monitor: one typed schema of the file that holds them. Units are in brackets."""

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
    """Limits of commands, independent of the robot's motion."""

    v: Positive = Field(description="largest |v| [m/s]")
    omega: Positive = Field(description="largest |omega| [rad/s]")
    v_reverse: NotNegative = Field(0.0, description="largest speed in reverse, if it differs from v; 0: v [m/s]")
    omega_right: NotNegative = Field(
        0.0, description="largest yaw rate to the right, if it differs from omega; 0: omega [rad/s]"
    )
    v_slew: Positive = Field(description="largest rate of change of v away from zero [m/s^2]")
    omega_slew: Positive = Field(description="largest rate of change of omega away from zero [rad/s^2]")
    v_braking: Positive = Field(
        description="largest rate of change of v towards zero; the monitor itself brakes at it [m/s^2]"
    )
    omega_braking: Positive = Field(
        description="largest rate of change of omega towards zero; the monitor itself brakes at it [rad/s^2]"
    )
    jitter: Positive = Field(description="tolerated error in the timing of commands, for the check of their slew [s]")
    silence: Positive = Field(description="longest time without a command while the last one moves the robot [s]")
    slowest: Positive = Field(description="longest mean interval between commands while the robot is moved [s]")
    quickest: Positive = Field(description="shortest mean interval between commands [s]")
    oldest: Positive = Field(description="largest age of a command that moves the robot, by its stamp [s]")
    stop_within: Positive = Field(
        description="time for commands to become zero after the controller says that it stands [s]"
    )
    standing_v: Positive = Field(description="a command or a motion up to this speed counts as standing [m/s]")
    standing_omega: Positive = Field(description="a command or a motion up to this yaw rate counts as standing [rad/s]")
    rest_distance: Positive = Field(
        0.05, description="largest distance that the wheels move after the controller says that it stands [m]"
    )
    rest_turn: Positive = Field(0.2, description="largest angle by which the wheels turn the robot meanwhile [rad]")

    @model_validator(mode="after")
    def _paces_in_order(self) -> Self:
        if self.quickest >= self.slowest:
            raise ValueError("commands.quickest must be shorter than commands.slowest")
        return self


class OnPath(StrictModel):
    """Bounds of the robot's place: near the stretch of path around the present reference."""

    distance: Positive = Field(description="largest distance from the stretch of path around the reference [m]")
    lasting: NotNegative = Field(description="longest time for which the distance may be larger [s]")
    far: Positive = Field(description="largest distance of the place where the robot would stand if it braked now [m]")
    reaction: NotNegative = Field(description="delay until braking begins [s]")
    heading: Positive = Field(description="largest angle to the headings of the stretch [rad]")
    far_lasting: NotNegative = Field(description="longest time for which `far` or `heading` may be exceeded [s]")
    late: NotNegative = Field(description="the stretch begins where the reference was so long ago [s]")
    early: NotNegative = Field(description="the stretch ends where the reference will be so much later [s]")
    grace: Positive = Field(
        description="longest motion without a reference, or while the controller says that it stands [s]"
    )


class Returning(StrictModel):
    """Bounds of a robot that returns after it was moved, has stood, or got a reference that starts elsewhere."""

    within: NotNegative = Field(description="longest time away from the stretch while the robot returns [s]")
    distance: Positive = Field(
        description="largest distance, meanwhile, of the place where it would stand if it braked now [m]"
    )
    late: NotNegative = Field(description="meanwhile, the stretch begins where the reference was so long ago [s]")
    early: NotNegative = Field(description="meanwhile, the stretch ends where the reference will be so much later [s]")


class SensorAges(StrictModel):
    """Largest ages of sensors while the robot is moved."""

    odometry_age: Annotated[float, Field(gt=0, le=60)] = Field(description="largest age of the odometry [s]")
    pose_age: Age = Field(
        description="largest age of the pose; 0: there is no pose sensor, and the pose of the odometry is used [s]"
    )
    gyro_age: Age = Field(
        description="largest age of the yaw rate; 0: there is no gyro, and the wheels measure the yaw rate [s]"
    )
    ahead: Positive = Field(description="largest time by which a stamp may lie in the future [s]")


class Agreement(StrictModel):
    """Largest differences between sensors."""

    window: Annotated[float, Field(gt=0, le=4)] = Field(description="time over which sensors are compared [s]")
    blend: Positive = Field(
        description="time constant with which poses correct the place that wheels and gyro carry on [s]"
    )
    distance: Positive = Field(description="largest difference between poses and wheels within the window [m]")
    distance_share: NotNegative = Field(description="additional difference per distance driven [m/m]")
    turn: Positive = Field(
        description="largest difference in heading of poses and gyro (no gyro: wheels) within the window [rad]"
    )
    gyro_gain: Positive = Field(description="largest ratio of the yaw rate of the gyro to that of the wheels [-]")
    gyro_least: NotNegative = Field(description="smallest ratio of the two [-]")
    gyro_turn: Positive = Field(description="tolerated turn beyond these ratios over the window [rad]")
    lasting: NotNegative = Field(description="longest time for which sensors may contradict each other [s]")


class ResponseBounds(StrictModel):
    """Bounds of the response to commands: first order with dead time."""

    dead_time: Annotated[float, Field(gt=0, le=2)] = Field(description="longest delay until a command acts [s]")
    lag_v: Positive = Field(description="largest time constant with which v follows [s]")
    lag_omega: Positive = Field(description="largest time constant with which omega follows [s]")
    gain_v: Positive = Field(description="largest ratio of v to its command [-]")
    gain_omega: Positive = Field(description="largest ratio of omega to its command [-]")
    margin_v: Positive = Field(description="tolerated speed beyond these bounds [m/s]")
    margin_omega: Positive = Field(description="tolerated yaw rate beyond these bounds [rad/s]")
    lasting: NotNegative = Field(description="longest time for which the robot may be outside the bounds [s]")


class Rules(StrictModel):
    """Rules that hold while a controller drives a robot."""

    name: str = Field("", max_length=80, description="robot for which they are")
    commands: CommandRules = Field(description="limits of commands")
    path: OnPath = Field(description="where the robot may be")
    returning: Returning = Field(description="where the robot may be while it returns to its path")
    sensors: SensorAges = Field(description="largest ages of sensors")
    agreement: Agreement = Field(description="largest differences between sensors")
    answer: ResponseBounds = Field(description="bounds of the response to commands")

    def with_sensors(self, *, pose: bool, gyro: bool) -> Self:
        """Return the rules for a robot that may lack a pose sensor or a gyro."""
        absent = {name: 0.0 for name, present in (("pose_age", pose), ("gyro_age", gyro)) if not present}
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
        If there is no such file, or a value is missing, unknown or out of range.
    """
    return load_checked(Rules, named_file("rules", FOLDER, name, shipped_names(FOLDER)))
