"""What the motors of a plant did during a sample: true torques, work, and what heats their windings."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.sim.plants.plant import Plant

WHEELS = 4


class MotorWork(NamedTuple):
    """Means over a sample of the physics' steps in it, (4,) each: front left, front right, rear left, rear right."""

    torque: FloatArray
    """at the wheels [N m]; positive drives forward"""
    speed: FloatArray
    """of the wheels [rad/s]"""
    power: FloatArray
    """mechanical [W]: torque times speed, of each step"""
    square: FloatArray
    """of the torque [N^2 m^2]: what heats the windings"""


NOTHING = MotorWork(*(np.full(WHEELS, np.nan) for _ in MotorWork._fields))
"""Of a plant without motors."""


def motor_work(plant: Plant) -> MotorWork:
    """What the motors of `plant` did during the last sample; `NOTHING` where it has none, as a velocity model."""
    motors: FloatArray | None = getattr(plant, "motors", None)
    if motors is None:
        return NOTHING
    torque, speed = motors[:, 0], motors[:, 1]
    mean_torque, mean_speed = motors.mean(axis=0)
    power, square = (np.einsum("sw,sw->w", torque, other) / len(motors) for other in (speed, torque))
    return MotorWork(mean_torque, mean_speed, power, square)


def stacked(rows: Sequence[MotorWork]) -> FloatArray:
    """(4, n, 4) the fields of n samples."""
    return np.array(rows, dtype=float).reshape(len(rows), len(MotorWork._fields), WHEELS).swapaxes(0, 1)
