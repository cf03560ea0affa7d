"""A controller that was given the true parameters of a simulated robot: what a commissioning is held against.

The physics has no velocity model of its own, so its true one is an SM identified from minutes of open-loop driving with
exact sensors, and its true sideways slip is the regression of exact motion.
"""

from __future__ import annotations

import datetime
from pathlib import Path

import numpy as np
import yaml

from diffdrive_mpc.models.identification.configuration import CONFIG_FILE, MODEL_FILE
from diffdrive_mpc.models.identification.horizon import choose_pace
from diffdrive_mpc.models.logs.record import Record
from diffdrive_mpc.models.output_error.validation import validate
from diffdrive_mpc.models.structures.identified import model_file, write_model_file
from diffdrive_mpc.models.structures.sm import identify_sm
from diffdrive_mpc.sim.plants.mujoco_plant import MujocoPlant
from diffdrive_mpc.sim.plants.open_loop import drive_open_loop, random_commands
from diffdrive_mpc.sim.plants.simulated_robot import load_simulated_robot
from diffdrive_mpc.sim.sensing.sensor_set import load_sensor_set

_SEEDS = (7000, 7001, 7002)
_SECONDS = 60.0


def write_informed(robot: Path, folder: Path) -> Path:
    """Write model and configuration of the informed controller into `folder`; gives the configuration's path.

    Raises
    ------
    models.checked_yaml.ConfigError, ValueError, OSError
        If the robot file has a mistake, or the folder cannot be written to.
    """
    build = load_simulated_robot(robot)
    exact, records, motions, slopes = load_sensor_set("perfect"), [], [], []
    for seed in _SEEDS:
        plant = MujocoPlant(
            build.friction or 1.0, exact, seed, robot=build.robot, twin=build.twin, firmware=build.firmware
        )
        drive = drive_open_loop(plant, random_commands(seed, smooth=False, duration=_SECONDS))
        body = np.column_stack([drive.true_twist[:, 0], drive.wheel_twist[:, 1]])
        name = f"exact drive {seed}"
        records.append(Record(name, 0.0, plant.sample_time, drive.command, twist=body, yaw_rate=drive.true_twist[:, 2]))
        motions.append(drive.true_twist)
        slopes.append(np.gradient(drive.true_twist[:, 0], plant.sample_time))
    found = identify_sm(records, limits=False)
    fit = validate(found.system, records).fit_percent
    content = model_file(
        found,
        name="true parameters",
        source=f"exact drives of {build.description}",
        records=[record.name for record in records],
        date=datetime.date.today(),
        train_fit_percent=fit,
        validation_fit_percent=fit,
        notes="scored on the drives that it is from",
    )
    (v, lateral, omega), slope = np.concatenate(motions).T, np.concatenate(slopes)
    side_slip, load_shift = np.linalg.lstsq(np.column_stack([-v * omega, slope * omega]), lateral, rcond=None)[0]
    pace = choose_pace(found.model, records[0].dt)
    config = {
        "model": MODEL_FILE,
        "horizon": pace.horizon,
        "wheels": {"track": build.firmware.track, "encoder_track": build.robot.track},
        "estimator": {"side_slip": max(0.0, float(side_slip)), "load_shift": max(0.0, float(load_shift))},
    }
    folder.mkdir(parents=True, exist_ok=True)
    write_model_file(folder / MODEL_FILE, content)
    path = folder / CONFIG_FILE
    path.write_text(yaml.safe_dump(config, sort_keys=False), encoding="utf-8")
    return path
