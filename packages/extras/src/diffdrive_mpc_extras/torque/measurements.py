"""Diagnostic drive of the simulated robot through a sequence of turns, and its log with battery and motors."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field

from diffdrive_mpc.models.checked_yaml import StrictModel, load_checked
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.robot import Positive
from diffdrive_mpc.models.whole_file import whole_file
from diffdrive_mpc.sim.plants.make import make_plant
from diffdrive_mpc.sim.plants.mujoco_plant import MujocoPlant
from diffdrive_mpc_extras.energy.power_readings import READINGS


class DiagnosticDrive(StrictModel):
    """Diagnostic drive as a sequence of turns."""

    radii: Annotated[tuple[float, ...], Field(min_length=3)] = Field(description="radii, positive to the left [m]")
    speeds: Annotated[tuple[Positive, ...], Field(min_length=1)] = Field(description="cyclic speeds of the turns [m/s]")
    hold: Positive = Field(description="duration of each turn [s]")


def load_diagnostic() -> DiagnosticDrive:
    """Read `diagnostic.yaml`; raises ConfigError if it is invalid."""
    return load_checked(DiagnosticDrive, Path(__file__).with_name("diagnostic.yaml"))


def diagnostic_commands(radii: Sequence[float], speeds: Sequence[float], hold: int, rest: int = 0) -> FloatArray:
    """Build commands (n, 2) v [m/s], omega [rad/s] of a sequence of turns, with rest before and after.

    Turn i has radius i [m] and the next of the cyclic speeds [m/s]; `hold` and `rest` are numbers of samples.
    """
    turn_speeds = np.resize(speeds, len(radii))
    turns = np.repeat(np.stack([turn_speeds, turn_speeds / np.array(radii)], axis=-1), hold, axis=0)
    standstill = np.zeros((rest, 2))
    return np.concatenate([standstill, turns, standstill])


_COLUMNS = (
    "t_s",
    "v_ref_m_s",
    "omega_ref_rad_s",
    "v_wheel_m_s",
    "omega_wheel_rad_s",
    *(f"wheel_{wheel}_rad_s" for wheel in ("fl", "fr", "rl", "rr")),
    "omega_gyro_rad_s",
    "pose_t_s",
    *(f"pose_{part}" for part in ("x_m", "y_m", "theta_rad")),
    *READINGS,
)
_REST = 3.0
"""Time at rest before and after the turns, which determines the power at rest [s]."""


def write_diagnostic_log(robot: str, surface: str, path: str | Path, seed: int = 0) -> None:
    """Drive the turns of `diagnostic.yaml` open loop, with rest before and after, and write a CSV log.

    The columns are those columns of `simulate --log` that a real robot can measure. The sensor set is `power`.

    Raises
    ------
    models.checked_yaml.ConfigError
        If robot or surface does not exist, or the file cannot be written.
    """
    settings = load_diagnostic()
    plant = make_plant(f"mujoco:{robot}", surface=surface, sensors="power", seed=seed)
    hold, rest = (round(time / plant.sample_time) for time in (settings.hold, _REST))
    commands = diagnostic_commands(settings.radii, settings.speeds, hold, rest)
    plant.reset(np.zeros(3))
    assert isinstance(plant, MujocoPlant)
    with (
        whole_file(path, begins=",".join(_COLUMNS).encode()) as draft,
        draft.open("w", encoding="utf-8", newline="") as file,
    ):
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(_COLUMNS)
        for command in commands:
            measurement = plant.measure()
            readings = [measurement.wheel_twist, measurement.wheel_speeds, measurement.yaw_rate]
            assert all(reading is not None for reading in readings)
            values = [np.ravel(reading.value) for reading in readings if reading is not None]
            pose = [""] * 4 if measurement.pose is None else [measurement.pose.time, *np.ravel(measurement.pose.value)]
            cells = np.concatenate([[plant.time], command, *values])
            writer.writerow([*map(repr, cells.tolist()), *pose, *map(repr, plant.parts["power"].value.tolist())])
            plant.advance(command)
