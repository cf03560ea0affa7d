"""Parameters of robots that are stated by the manufacturers instead of identified, with their sources."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Literal, NamedTuple, Self

from pydantic import Field, model_validator

from diffdrive_mpc.models.checked_yaml import ConfigError, StrictModel
from diffdrive_mpc.models.logs.mapping import LogMapping, Topic, Topics
from diffdrive_mpc.models.named_file import EntryFile
from diffdrive_mpc.models.plug_ins import plug_in_names
from diffdrive_mpc.models.robot import load_robot

STATED_ROBOTS = EntryFile("robot", Path(__file__).with_name("stated_robots.yaml"))
TO_IDENTIFY = "gain, lag and dead time of both channels, true over commanded yaw rate, slip, noise of the sensors"
"""Description of the parameters that no manufacturer states."""

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
_UNITS = {
    "wheels": "-",
    "wheel_radius": "m",
    "wheel_separation": "m",
    "wheel_separation_multiplier": "-",
    "v": "m/s",
    "omega": "rad/s",
    "v_rate": "m/s^2",
    "v_braking": "m/s^2",
    "omega_rate": "rad/s^2",
    "omega_braking": "rad/s^2",
    "command_rate": "Hz",
    "command_timeout": "s",
    "footprint_radius": "m",
}


class StatedNumber(StrictModel):
    """Number stated by the manufacturer, with its source."""

    stated: Positive
    source: str = Field(min_length=1, description="one of the file's `sources`")


class StatedOutline(StrictModel):
    """Corners of the robot in the frame of its base."""

    stated: tuple[tuple[float, float], ...] = Field(min_length=3, description="x, y of each corner [m]")
    source: str = Field(min_length=1, description="one of the file's `sources`")


class StatedTopic(StrictModel):
    """Topic, relative to the namespace of the robot."""

    stated: str = Field(min_length=1, pattern="^[^/]", description="relative name")
    type: str = Field(description="type of its messages")
    source: str = Field(min_length=1, description="one of the file's `sources`")


class StatedTopics(StrictModel):
    """Topics of command and sensors."""

    command: StatedTopic
    odometry: StatedTopic
    imu: StatedTopic | None = None


class StatedKey(NamedTuple):
    """Value of a controller's configuration, derived from stated data."""

    value: float | str
    reason: str
    """Unit and derivation."""


class ManufacturerRobot(StrictModel):
    """Data of one robot stated by the manufacturer, in SI units; values that are not stated are omitted."""

    name: str
    provenance: Literal["stated"] = Field(description="not identified: the values do not come from a log")
    sources: dict[str, str] = Field(description="repository, file and revision, by the key that values refer to")
    wheels: StatedNumber = Field(description="driven wheels [-]")
    wheel_radius: StatedNumber = Field(description="radius of the wheels [m]")
    wheel_separation: StatedNumber = Field(description="distance between left and right wheels [m]")
    wheel_separation_multiplier: StatedNumber = Field(description="track used by the base over wheel separation [-]")
    v: StatedNumber = Field(description="maximum forward command [m/s]")
    omega: StatedNumber = Field(description="maximum yaw command [rad/s]")
    v_rate: StatedNumber | None = Field(None, description="maximum acceleration of the forward command [m/s^2]")
    v_braking: StatedNumber | None = Field(None, description="maximum deceleration of the forward command [m/s^2]")
    omega_rate: StatedNumber | None = Field(None, description="maximum acceleration of the yaw command [rad/s^2]")
    omega_braking: StatedNumber | None = Field(None, description="maximum deceleration of the yaw command [rad/s^2]")
    command_rate: StatedNumber | None = Field(None, description="rate at which the base accepts commands [Hz]")
    command_timeout: StatedNumber | None = Field(None, description="time without a command after which it stops [s]")
    footprint: StatedOutline | None = None
    footprint_radius: StatedNumber | None = Field(None, description="radius of a round robot, in place of corners [m]")
    topics: StatedTopics

    @model_validator(mode="after")
    def _check_sources(self) -> Self:
        stated = [part for part in (*dict(self).values(), *dict(self.topics).values()) if hasattr(part, "source")]
        unknown = sorted({part.source for part in stated} - set(self.sources))
        if unknown:
            raise ValueError(f"source '{unknown[0]}' is not one of its sources: {', '.join(self.sources)}")
        return self

    @property
    def track(self) -> float:
        """Track [m] with which the base converts omega to wheel speeds, and wheel speeds to odometry."""
        return self.wheel_separation.stated * self.wheel_separation_multiplier.stated

    def bounds(self, margin: float) -> dict[str, float]:
        """Return soft limits, which manufacturers do not state, as `margin` [-] times the maximum command."""
        v, omega = self.v.stated, self.omega.stated
        rim = v + 0.5 * self.track * omega
        sizes = {"predicted_v": v, "predicted_omega": omega, "wheel_speed": rim}
        return {f"limits.{name}": float(f"{margin * size:.4g}") for name, size in sizes.items()}

    def configuration(self) -> dict[str, StatedKey]:
        """Return values of a controller's configuration by dotted key, with slew limits below the default only."""
        separation = (
            f"m, wheel separation {self.wheel_separation.stated:g} m times multiplier "
            f"{self.wheel_separation_multiplier.stated:g}"
        )
        keys = {
            "limits.v": StatedKey(self.v.stated, "m/s"),
            "limits.omega": StatedKey(self.omega.stated, "rad/s"),
            "wheels.track": StatedKey(float(f"{self.track:.6g}"), separation),
            "wheels.encoder_track": StatedKey(float(f"{self.track:.6g}"), separation),
        }
        default = load_robot().command_slew
        for channel, unit in (("v", "m/s^2"), ("omega", "rad/s^2")):
            for key, rate in (("slew", "rate"), ("braking", "braking")):
                number: StatedNumber | None = getattr(self, f"{channel}_{rate}")
                if number is not None and number.stated < getattr(default, channel):
                    keys[f"limits.{channel}_{key}"] = StatedKey(number.stated, unit)
        # If the feature is not installed, its group in a configuration is an error.
        if "free_space" not in plug_in_names("features"):
            return keys
        if self.footprint is not None:
            corners = json.dumps([list(corner) for corner in self.footprint.stated])
            keys["free_space.footprint"] = StatedKey(corners, "m")
        if self.footprint_radius is not None:
            keys["free_space.footprint"] = StatedKey("[[0.0, 0.0]]", "m, a disc")
            keys["free_space.footprint_radius"] = StatedKey(self.footprint_radius.stated, "m")
        return keys

    def mapping(self) -> LogMapping:
        """Return the mapping of the topics in a bag of this robot, for any namespace."""
        names = {role: Topic(topic=topic.stated) for role, topic in dict(self.topics).items() if topic is not None}
        return LogMapping(source=f"{self.name}, as stated by the manufacturer", topics=Topics(**names))

    def lines(self) -> list[str]:
        """Return the stated values with their sources, and the parameters to be identified, in one line each."""
        numbers = [(name, unit, getattr(self, name)) for name, unit in _UNITS.items()]
        lines = [
            f"{name} {number.stated:g}{'' if unit == '-' else f' {unit}'} (stated: {number.source})"
            for name, unit, number in numbers
            if number is not None
        ]
        if self.footprint is not None:
            corners = ", ".join(f"({x:g}, {y:g})" for x, y in self.footprint.stated)
            lines.append(f"footprint {corners} m (stated: {self.footprint.source})")
        lines += [
            f"{role} {topic.stated} {topic.type} (stated: {topic.source})"
            for role, topic in dict(self.topics).items()
            if topic is not None
        ]
        lines += [f"source {word}: {source}" for word, source in self.sources.items()]
        return [*lines, f"not stated, to be identified from a log: {TO_IDENTIFY}"]


def load_stated_robot(name: str | Path) -> ManufacturerRobot:
    """Read the manufacturer's data of a robot.

    Parameters
    ----------
    name
        Name of a robot ("husky", "jackal", ...) or path of a file with stated data.

    Raises
    ------
    models.checked_yaml.ConfigError
        If there is no such robot, with a list of the names, or its file is invalid.
    """
    robot = STATED_ROBOTS.load(ManufacturerRobot, name)
    if robot.footprint is not None and robot.footprint_radius is not None:
        raise ConfigError(f"{name}: give 'footprint' or 'footprint_radius', not both")
    return robot
