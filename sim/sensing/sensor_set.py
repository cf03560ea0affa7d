"""Parameters of the sensors around a plant."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from diffdrive_mpc.models.checked_yaml import StrictModel, merge_mappings
from diffdrive_mpc.models.named_file import EntryFile

SENSOR_SETS = EntryFile("sensor set", Path(__file__).with_name("sensor_sets.yaml"))
Deviation = Annotated[float, Field(ge=0, le=1e3)]
"""A standard deviation [m, rad or rad/s]: beyond a kilometre or a thousand turns nothing is measured."""


Scale = Annotated[float, Field(ge=-100, le=100)]


class PoseSensor(StrictModel):
    """SLAM, motion capture or the like."""

    # The number of pending poses is latency over period: without bounds on both, a typing error could fill the memory.
    period: float | None = Field(ge=1e-3, description="time between poses [s]; null: every control sample")
    latency: float = Field(ge=0, le=2, description="from the instant a pose describes to its delivery [s]")
    position_sd: Deviation = Field(description="standard deviation of x and of y [m]")
    heading_sd: Deviation = Field(description="standard deviation of theta [rad]")
    stated_position_sd: Deviation | None = Field(
        default=None, description="what the pose says of position_sd [m]; null: the truth"
    )
    loss: float = Field(default=0.0, ge=0, lt=1, description="share of the poses that never arrive, drawn one by one")
    stamped_on_arrival: bool = Field(
        default=False, description="whether the stamp is the instant of delivery, as if the pose were not late"
    )
    turned: float = Field(default=0.0, ge=-7, le=7, description="angle by which theta is ahead of the robot [rad]")
    mirrored: bool = Field(default=False, description="whether y runs the other way, and theta does not")
    theta_sign: Literal[1, -1] = Field(default=1, description="-1: theta runs clockwise [-]")


class Gyro(StrictModel):
    """Yaw-rate gyro."""

    noise_sd: Deviation = Field(description="standard deviation of the white noise of a sample [rad/s]")
    bias_sd: Deviation = Field(description="standard deviation of the bias over seeds; constant in a run [rad/s]")
    scale: Scale = Field(default=1.0, description="reading over yaw rate; negative: mounted upside down [-]")
    largest: float = Field(default=1e3, gt=0, le=1e3, description="size at which readings rest [rad/s]")


class Encoders(StrictModel):
    """Speed estimates of the motor drivers."""

    speed_sd: Deviation = Field(description="standard deviation of one wheel's speed estimate [rad/s]; 0: exact")
    left: Scale = Field(default=1.0, description="reading over speed of the left wheels; negative: reversed [-]")
    right: Scale = Field(default=1.0, description="reading over speed of the right wheels; negative: reversed [-]")
    swapped: bool = Field(default=False, description="whether the sides are exchanged")


class SensorSet(StrictModel):
    """All sensors of one robot."""

    pose: PoseSensor
    gyro: Gyro
    encoders: Encoders
    parts: dict[str, Any] = Field(
        default_factory=dict, description="values for simulator parts of other packages, by their names"
    )

    @model_validator(mode="before")
    @classmethod
    def _read_former_key(cls, data: Any) -> Any:  # noqa: ANN401 - content of a file
        """Read `power`, the key of version 0.2, as `parts.power`."""
        if not isinstance(data, Mapping) or "power" not in data:
            return data
        values = {key: value for key, value in data.items() if key != "power"}
        return values if data["power"] is None else merge_mappings(values, {"parts": {"power": data["power"]}})


def load_sensor_set(name: str | Path) -> SensorSet:
    """Read a sensor set by shipped name or path; values missing in its file are those of the default set.

    Raises
    ------
    models.checked_yaml.ConfigError
        If there is no such set or its file has a mistake.
    """
    default = SENSOR_SETS.load(SensorSet, "default")
    return SENSOR_SETS.load(SensorSet, name, default.model_dump())
