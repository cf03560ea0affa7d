"""Log of a diagnostic drive of the simulated robot: turns held one after the other, with battery and motors."""

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


class Diagnostic(StrictModel):
    """Diagnostic drive: turns held one after the other."""

    radii: Annotated[tuple[float, ...], Field(min_length=3)] = Field(description="positive to the left [m]")
    speeds: Annotated[tuple[Positive, ...], Field(min_length=1)] = Field(description="of the turns, in rotation [m/s]")
    hold: Positive = Field(description="duration of each turn [s]")


def load_diagnostic() -> Diagnostic:
    """Read `diagnostic.yaml`."""
    return load_checked(Diagnostic, Path(__file__).with_name("diagnostic.yaml"))


def diagnostic_commands(radii: Sequence[float], speeds: Sequence[float], hold: int, rest: int = 0) -> FloatArray:
    """Build turns (n, 2) held in sequence for `hold` samples, speeds in turn, with rest before and after."""
    each = np.resize(speeds, len(radii))
    rows = np.repeat(np.stack([each, each / np.array(radii)], axis=-1), hold, axis=0)
    still = np.zeros((rest, 2))
    return np.concatenate([still, rows, still])


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
# Time at rest before and after the turns [s]: it determines the power drawn at rest.
_REST = 3.0


def write_diagnostic_log(robot: str, surface: str, path: str | Path, seed: int = 0) -> None:
    """Drive the turns of `diagnostic.yaml` open loop, with rest before and after, and write a CSV log.

    Its columns are those of `simulate --log` that a robot has; sensors are the set `power`.

    Raises
    ------
    models.checked_yaml.ConfigError
        If robot or floor do not exist, or the file cannot be written.
    """
    settings = load_diagnostic()
    plant = make_plant(f"mujoco:{robot}", surface=surface, sensors="power", seed=seed)
    hold, rest = (round(time / plant.sample_time) for time in (settings.hold, _REST))
    commands = diagnostic_commands(settings.radii, settings.speeds, hold, rest)
    plant.reset(np.zeros(3))
    assert isinstance(plant, MujocoPlant)
    with whole_file(path) as draft, draft.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(_COLUMNS)
        for command in commands:
            measured = plant.measure()
            parts = [measured.wheel_twist, measured.wheel_speeds, measured.yaw_rate]
            assert all(part is not None for part in parts)
            read = [np.ravel(part.value) for part in parts if part is not None]
            pose = [""] * 4 if measured.pose is None else [measured.pose.time, *np.ravel(measured.pose.value)]
            cells = np.concatenate([[plant.time], command, *read])
            writer.writerow([*map(repr, cells.tolist()), *pose, *map(repr, plant.parts["power"].value.tolist())])
            plant.advance(command)
