"""Command rows of the identification experiments: the papers' steps, and random set-points."""

from __future__ import annotations

from functools import cache
from typing import Literal

import numpy as np

from diffdrive_mpc.models.checked_yaml import StrictModel, load_checked
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.robot import Positive, Robot, load_robot
from diffdrive_mpc.sim.plants.surface import NotNegative
from diffdrive_mpc.sim.plants.twin_parameters import PARAMETERS


class StepDrives(StrictModel):
    """Steps from rest to a level and back."""

    wheel_levels: list[float]
    v_levels: list[float]
    omega_levels: list[float]
    rest_before: NotNegative
    hold: Positive
    rest_after: NotNegative


class RandomDrives(StrictModel):
    """Random set-points, each held for a random time."""

    v_range: tuple[float, float]
    omega_range: tuple[float, float]
    hold_range: tuple[Positive, Positive]
    smoothing: Positive
    duration: Positive


class DriveParameters(StrictModel):
    """All experiments."""

    steps: StepDrives
    random: RandomDrives


@cache
def load_drive_parameters() -> DriveParameters:
    """Read the experiments' parameter file; raises ConfigError on a mistake in it."""
    return load_checked(DriveParameters, PARAMETERS / "drives.yaml")


def step_drives(kind: Literal["wheels", "v", "omega"], robot: Robot | None = None) -> list[FloatArray]:
    """One command row (K, 2) per step level: rest, step, rest.

    Parameters
    ----------
    kind
        "wheels": straight on at the pulse rates from which the papers identify MBM; "v" and "omega": the steps of SM.
    robot
        Wheel radius, encoder and sample time; by default the robot of the papers.
    """
    robot, steps = robot or load_robot(), load_drive_parameters().steps
    metres_per_pulse = 2 * np.pi * robot.wheel_radius / robot.encoder_pulses
    twists = {
        "wheels": [(pulses * metres_per_pulse, 0.0) for pulses in steps.wheel_levels],
        "v": [(v, 0.0) for v in steps.v_levels],
        "omega": [(0.0, omega) for omega in steps.omega_levels],
    }[kind]
    before, hold, after = (round(t / robot.sample_time) for t in (steps.rest_before, steps.hold, steps.rest_after))
    return [np.vstack([np.zeros((before, 2)), np.tile(twist, (hold, 1)), np.zeros((after, 2))]) for twist in twists]


def random_drive(
    seed: int, smooth: bool = True, duration: float | None = None, sample_time: float | None = None
) -> FloatArray:
    """(K, 2) random set-points, each held for a random time; the robot comes from rest.

    Parameters
    ----------
    seed
        Seed of set-points and holding times.
    smooth
        Average over the last half second; otherwise set-points change in steps.
    duration, sample_time
        [s]; by default those of the parameter file and of the robot.
    """
    parameters = load_drive_parameters().random
    dt = sample_time or load_robot().sample_time
    count = round((duration or parameters.duration) / dt)
    stream = np.random.default_rng(seed)
    low, high = np.transpose([parameters.v_range, parameters.omega_range])
    rows: list[FloatArray] = []
    while sum(map(len, rows)) < count:
        hold = max(1, round(stream.uniform(*parameters.hold_range) / dt))
        rows.append(np.tile(stream.uniform(low, high), (hold, 1)))
    commands = np.vstack(rows)[:count]
    if not smooth:
        return commands
    window = max(1, round(parameters.smoothing / dt))
    total = np.cumsum(np.vstack([np.zeros((window, 2)), commands]), axis=0)
    return np.asarray((total[window:] - total[:-window]) / window)
