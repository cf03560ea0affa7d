"""Parameters of the sensors of a plant."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from diffdrive_mpc.models.checked_yaml import StrictModel, check, merge_mappings
from diffdrive_mpc.models.named_file import EntryFile

SENSOR_SETS = EntryFile("sensor set", Path(__file__).with_name("sensor_sets.yaml"))
Deviation = Annotated[float, Field(ge=0, le=1e3)]
"""Standard deviation [m, rad or rad/s], with an upper bound that detects typing errors."""

Scale = Annotated[float, Field(ge=-100, le=100)]


class PoseSensor(StrictModel):
    """Pose sensor, such as SLAM or motion capture."""

    # The number of pending poses is latency over period; bounds on both limit the memory.
    period: float | None = Field(ge=1e-3, description="time between poses [s]; null: every control sample")
    latency: float = Field(ge=0, le=2, description="time from validity to delivery of a pose [s]")
    position_sd: Deviation = Field(description="standard deviation of x and y [m]")
    heading_sd: Deviation = Field(description="standard deviation of theta [rad]")
    stated_position_sd: Deviation | None = Field(
        default=None, description="standard deviation in the covariance of poses [m]; null: the true value"
    )
    loss: float = Field(default=0.0, ge=0, lt=1, description="probability that a pose is lost [-]")
    stamped_on_arrival: bool = Field(
        default=False, description="true if the stamp is the time of delivery instead of validity"
    )
    turned: float = Field(default=0.0, ge=-7, le=7, description="theta of poses minus theta of the robot [rad]")
    mirrored: bool = Field(default=False, description="true if the sign of y, but not that of theta, is inverted")
    theta_sign: Literal[1, -1] = Field(default=1, description="-1: theta is positive clockwise [-]")


class Gyro(StrictModel):
    """Gyro for the yaw rate."""

    noise_sd: Deviation = Field(description="standard deviation of the white noise of a sample [rad/s]")
    bias_sd: Deviation = Field(
        description="standard deviation of the bias over seeds; the bias is constant during a run [rad/s]"
    )
    scale: Scale = Field(default=1.0, description="ratio of reading to yaw rate; negative: mounted upside down [-]")
    largest: float = Field(
        default=1e3, gt=0, le=1e3, description="absolute value at which readings are clipped [rad/s]"
    )


class Encoders(StrictModel):
    """Speed estimates of the motor drivers."""

    speed_sd: Deviation = Field(description="standard deviation of the speed estimate of a wheel [rad/s]; 0: exact")
    left: Scale = Field(default=1.0, description="ratio of reading to speed of the left wheels; negative: reversed [-]")
    right: Scale = Field(
        default=1.0, description="ratio of reading to speed of the right wheels; negative: reversed [-]"
    )
    swapped: bool = Field(default=False, description="true if the sides are exchanged")


class SensorSet(StrictModel):
    """Sensors of a robot."""

    pose: PoseSensor
    gyro: Gyro
    encoders: Encoders
    parts: dict[str, Any] = Field(
        default_factory=dict, description="values for simulator parts of other packages, by name"
    )


def load_sensor_set(name: str | Path, readings: Mapping[str, Any] | None = None) -> SensorSet:
    """Read a sensor set by built-in name or path; missing values are those of the default set.

    `readings` contains values by group and key that replace those of the default set, if this is the set to be read.

    Raises
    ------
    models.checked_yaml.ConfigError
        If the set does not exist or its file is invalid.
    """
    default = SENSOR_SETS.load(SensorSet, "default").model_dump()
    if name == "default":
        return check(SensorSet, merge_mappings(default, readings or {}), "sensor set")
    return SENSOR_SETS.load(SensorSet, name, default)
