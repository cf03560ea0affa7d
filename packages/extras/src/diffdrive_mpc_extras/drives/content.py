"""From a fitted drive to what its parameter file says."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from diffdrive_mpc.models.checked_yaml import StrictModel, load_checked
from diffdrive_mpc.models.logs.geometry import WheelGeometry
from diffdrive_mpc.models.robot import Positive, load_robot
from diffdrive_mpc.models.structures.identified import rounded
from diffdrive_mpc.models.velocity_model import CHANNELS
from diffdrive_mpc_extras.drives.drive_model import DRIVE_FILES, DriveChassis, ExperimentalFile, PhysicalFile
from diffdrive_mpc_extras.drives.fitting import DriveFit


class ParameterRange(StrictModel):
    """Where a number is looked for."""

    low: float
    high: float
    size: Positive = Field(description="a usual change of it")


class FitSettings(StrictModel):
    """The search."""

    most_dead_time: Positive = Field(description="[s]")
    most_steps: Annotated[int, Field(ge=1)] = Field(description="of one least-squares search [-]")
    still: tuple[Positive, Positive] = Field(description="speed below which a robot stands [m/s], [rad/s]")
    actuator_lag: Positive = Field(description="of the physical model, not searched [s]")
    friction: Positive = Field(description="viscous, of the physical model, not searched [N m s/rad]")
    bounds: dict[str, ParameterRange]
    starts: tuple[dict[str, float], ...]
    priors: dict[str, float] = Field(description="of numbers that a log need not tell")
    min_gain: Positive = Field(description="rise of the error power that a prior has to cost, or it is kept [-]")


@cache
def fit_settings() -> FitSettings:
    """Read the file; raises ConfigError on a mistake in it."""
    return load_checked(FitSettings, Path(__file__).with_name("settings.yaml"))


def drive_content(
    fit: DriveFit, fields: Mapping[str, Any], geometry: WheelGeometry | None = None
) -> ExperimentalFile | PhysicalFile:
    """What the parameter file of `fit` says.

    Parameters
    ----------
    fields
        Name, provenance, scores and warnings.
    geometry
        Of the robot's wheels; by default that of the papers' robot, whose mass it has in any case.

    Raises
    ------
    pydantic.ValidationError
        If a number cannot be a robot's.
    """
    content = {
        "structure": fit.kind,
        **fields,
        "sample_time": fit.dt,
        **(_physical(fit, geometry) if fit.kind == "drive_physical" else {}),
        **{channel: _channel(fit, row) for row, channel in enumerate(CHANNELS)},
    }
    return DRIVE_FILES[fit.kind].model_validate(content)


def _channel(fit: DriveFit, row: int) -> dict[str, float]:
    """What a file says of a channel: not what belongs to both, nor to the sensor."""
    keys = set(fit.values[row]) - {"offset", "stiffness", "integral_time"}
    return {
        "dead_samples": fit.dead_samples[row],
        "still": fit_settings().still[row],
        **{key: rounded(fit.values[row][key]) for key in fit.values[row] if key in keys},
    }


def _physical(fit: DriveFit, geometry: WheelGeometry | None) -> dict[str, dict[str, float]]:
    """Chassis and drive whose ratios are those that were found, without inertia of wheels and rotors."""
    robot = load_robot()
    radius, track = geometry or (robot.wheel_radius, robot.track)
    forward, turning = fit.values[0]["stiffness"], fit.values[1]["stiffness"]
    together = robot.mass * radius**2 / 2
    apart = together * forward / turning
    chassis = DriveChassis(
        mass=robot.mass,
        wheel_radius=radius,
        track=track,
        centre_ahead=0.0,
        yaw_inertia=rounded(apart / 2 * track**2 / radius**2),
        wheel_inertia=0.0,
    )
    drive = {
        "proportional_gain": rounded(forward * (chassis.own + chassis.other)),
        "integral_time": rounded(fit.values[0]["integral_time"]),
        "actuator_lag": fit_settings().actuator_lag,
        "friction": fit_settings().friction,
    }
    return {"chassis": chassis.model_dump(), "wheel_drive": drive}
