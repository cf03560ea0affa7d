"""A drive of the simulated robot whose battery and motors are read once for each of several drive constants."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.record import Record
from diffdrive_mpc.models.turn_costs import DriveConstants
from diffdrive_mpc.sim.plants.mujoco_plant import MujocoPlant
from diffdrive_mpc.sim.sensing.battery import Battery
from diffdrive_mpc.sim.sensing.power_readings import PowerReadings
from diffdrive_mpc.sim.sensing.sensor_set import load_sensor_set


class Driven(NamedTuple):
    """What happened, n ticks; the physics does not depend on what is read."""

    dt: float
    command: FloatArray
    speeds: FloatArray
    """(n, 4) as the encoders say [rad/s]"""
    motors: FloatArray
    """(n, steps, 2, 4) in the sample before the tick"""


def driven(plant: MujocoPlant, commands: FloatArray) -> Driven:
    """Drive, and keep what every motor did in every step."""
    plant.reset(np.zeros(3))
    speeds, motors = [], []
    done = np.zeros_like(plant.motors)
    for command in commands:
        measured = plant.measure().wheel_speeds
        assert measured is not None
        speeds.append(np.asarray(measured.value))
        motors.append(done)
        plant.advance(command)
        done = plant.motors.copy()
    return Driven(plant.sample_time, commands, np.array(speeds), np.array(motors))


def record(drive: Driven, constants: DriveConstants, seed: int, battery: Battery | None = None) -> Record:
    """What a log of the drive holds with sensors of power, for a robot with these constants."""
    sensor = load_sensor_set("power").power
    assert sensor is not None
    reads = PowerReadings(sensor, battery or Battery(voltage=16.8, resistance=0.1), constants, seed)
    rows = []
    for motors in drive.motors:
        reads.take(motors)
        rows.append(reads.value)
    read = np.array(rows)
    sides = 0.5 * (drive.speeds[:, :2] + drive.speeds[:, 2:])
    return Record(
        "drive",
        0.0,
        drive.dt,
        drive.command,
        wheels=sides,
        wheel_speeds=drive.speeds,
        battery=read[:, :2],
        motor_current=read[:, 2:4] + read[:, 4:],
        motor_currents=read[:, 2:],
    )


def drawn(usual: DriveConstants, rng: np.random.Generator) -> DriveConstants:
    """Constants of another robot with the same gears: a half to twice, and a computer of 2 to 20 W."""
    torque, resistance = np.exp(rng.uniform(np.log(0.5), np.log(2.0), 2))
    changes = {
        "torque_constant": usual.torque_constant * torque,
        "resistance": usual.resistance * resistance,
        "idle_power": rng.uniform(2.0, 20.0),
        "regeneration": bool(rng.random() < 0.5),
        "driver_efficiency": rng.uniform(0.85, 1.0),
    }
    return usual.model_copy(update=changes)
