"""Settings of the simulated base: topics' rates, command timeout, lock step."""

from __future__ import annotations

from collections.abc import Mapping
from functools import reduce
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from diffdrive_mpc.models.checked_yaml import StrictModel, check, load_checked

SHIPPED = Path(__file__).parent / "base.yaml"

Ticks = Annotated[int, Field(ge=1, le=1000)]
Seconds = Annotated[float, Field(gt=0, le=60)]


class Every(StrictModel):
    """Control samples from one message of a topic to the next."""

    odometry: Ticks = Field(description="odom")
    imu: Ticks = Field(description="imu")
    joint_states: Ticks = Field(description="joint_states")
    ground_truth: Ticks = Field(description="ground_truth/pose and ground_truth/twist")


class LockStep(StrictModel):
    """How the clock and the commands take turns."""

    # A sensor's latency may be 2 s: stamps of poses from before the start must not fall below zero.
    first_tick: int = Field(ge=200, le=1_000_000, description="control samples on /clock at the start")
    settling_time: Seconds = Field(
        description="real time without a new connection before the first tick [s]; others may be about to come"
    )
    answer_timeout: Seconds = Field(description="real time to wait for the command to a tick [s]")
    clock_repeat: Seconds = Field(description="real time after which an unanswered /clock is sent again [s]")


class RealTime(StrictModel):
    """How the base keeps pace with the wall clock."""

    most_behind: Seconds = Field(description="delay beyond which lost time is given up [s]")


class BaseSettings(StrictModel):
    """All settings of the simulated base."""

    stamped: bool = Field(description="commands are TwistStamped; false: Twist")
    command_timeout: Seconds = Field(description="robot time without a command until the base stops [s]")
    odometry_pose: Literal["dead_reckoning", "pose_sensor"] = Field(description="where the pose in odom comes from")
    every: Every
    lock_step: LockStep
    real_time: RealTime


def load_base_settings(path: str | Path | None = None, changes: Mapping[str, object] | None = None) -> BaseSettings:
    """Read base settings; without a path, the shipped ones.

    Parameters
    ----------
    path
        A YAML file with all settings.
    changes
        Values that replace those of the file, by dotted key such as "lock_step.answer_timeout"; None leaves the file's.

    Raises
    ------
    models.checked_yaml.ConfigError
        If the file cannot be read or a value is missing, unknown or out of range.
    """
    settings = load_checked(BaseSettings, path or SHIPPED)
    values = settings.model_dump()
    for key, value in (changes or {}).items():
        if value is not None:
            *groups, name = key.split(".")
            reduce(dict.__getitem__, groups, values)[name] = value
    return check(BaseSettings, values, "base settings")
