"""The diagnostic drive of the simulated robot as a log with battery and motors, as a real robot would have left it."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from diffdrive_mpc.models.whole_file import whole_file
from diffdrive_mpc.sim.plants.make import make_plant
from diffdrive_mpc.sim.sensing.power_readings import READINGS, power_read
from studies.torque.measurements import diagnostic_commands
from studies.torque.settings import load_study

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
# Before and after the turns it stands [s]: what is drawn at rest is told by that.
_REST = 3.0


def write_diagnostic_log(robot: str, surface: str, path: str | Path, seed: int = 0) -> None:
    """Drive the turns of the torque study open loop, with rest before and after, and write a CSV log.

    Its columns are those of `simulate --log` that a robot has; sensors are the set `power`.

    Raises
    ------
    models.checked_yaml.ConfigError
        If robot or floor do not exist, or the file cannot be written.
    """
    asked = load_study().diagnostic
    plant = make_plant(f"mujoco:{robot}", surface=surface, sensors="power", seed=seed)
    hold, rest = (round(time / plant.sample_time) for time in (asked.hold, _REST))
    commands = diagnostic_commands(asked.radii, asked.speeds, hold, rest)
    plant.reset(np.zeros(3))
    with whole_file(path) as draft, draft.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(_COLUMNS)
        for command in commands:
            found = plant.measure()
            parts = [found.wheel_twist, found.wheel_speeds, found.yaw_rate]
            assert all(part is not None for part in parts)
            read = [np.ravel(part.value) for part in parts if part is not None]
            pose = [""] * 4 if found.pose is None else [found.pose.time, *np.ravel(found.pose.value)]
            cells = np.concatenate([[plant.time], command, *read])
            writer.writerow([*map(repr, cells.tolist()), *pose, *map(repr, power_read(plant).tolist())])
            plant.advance(command)
