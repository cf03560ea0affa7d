"""Plants with known parameters, and logs of them."""

import numpy as np

from diffdrive_mpc.models.checked_yaml import laid_over
from diffdrive_mpc.models.identification.effects.free_run import sensed
from diffdrive_mpc.models.identification.from_logs import identify_data
from diffdrive_mpc.models.identification.log_data import LogData, divide
from diffdrive_mpc.models.logs import Record
from diffdrive_mpc.models.output_error.experiment import joined
from diffdrive_mpc.models.structures.registry import STRUCTURES
from diffdrive_mpc.sim.plants.mujoco_plant import MujocoPlant
from diffdrive_mpc.sim.plants.open_loop import drive_open_loop, random_commands
from diffdrive_mpc.sim.plants.simulated_robot import SimulatedRobot, load_simulated_robot
from diffdrive_mpc_extras.twin.fitting import fit_twin
from diffdrive_mpc_extras.twin.free_run import most_telling
from diffdrive_mpc_extras.twin.held_out import identified
from diffdrive_mpc_extras.twin.nominal import nominal_robot
from diffdrive_mpc_extras.twin.problem import TwinProblem
from diffdrive_mpc_extras.twin.space import space_of

MOTORS = """\
description: what is known of it, the motors' data sheet
robot: {encoder_pulses: 537.7}
twin:
  chassis: {body_size: [0.30, 0.24, 0.10]}
  motor: {stall_torque: 2.38, no_load_speed: 32.67, rotor_inertia: 0.0026}
  driver: {proportional_gain: 0.2, integral_gain: 3.0}
"""


def drawn_truth(seed):
    """Friction, dead time, lags, gain, tracks and mass of a plant, in the terms of a fit."""
    stream = np.random.default_rng(seed)

    def factor(spread):
        return float(np.exp(stream.normal(0.0, spread)))

    return {
        "mass": 6.85 * factor(0.3),
        "dead_time": float(stream.uniform(0.01, 0.09)),
        "gain_v": factor(0.05),
        "lag_v": 0.1 * factor(0.4),
        "lag_omega": 0.05 * factor(0.4),
        "track": 0.39 * factor(0.15),
        "friction": 0.7 * factor(0.3),
        "wheel_base": 0.16 * factor(0.25),
    }


def known_robot(truth):
    changes = {
        "robot": {"mass": truth["mass"]},
        "twin": {"link": {"dead_time": truth["dead_time"]}, "chassis": {"wheel_base": truth["wheel_base"]}},
        "firmware": {name: truth[name] for name in ("gain_v", "lag_v", "lag_omega", "track")},
        "friction": truth["friction"],
    }
    return SimulatedRobot.model_validate(laid_over(load_simulated_robot("heavy").model_dump(), changes))


def record_of(robot, seed, seconds):
    """An open-loop drive with the default sensors."""
    plant = MujocoPlant(
        robot.friction, robot.sensors, seed, robot=robot.robot, twin=robot.twin, firmware=robot.firmware
    )
    drive = drive_open_loop(plant, random_commands(seed, smooth=False, duration=seconds))
    sides = np.column_stack([drive.wheel_speeds[:, [0, 2]].mean(axis=1), drive.wheel_speeds[:, [1, 3]].mean(axis=1)])
    return Record(
        "drive",
        0.0,
        plant.sample_time,
        drive.command,
        twist=drive.wheel_twist,
        yaw_rate=drive.yaw_rate,
        wheels=sides,
        wheel_speeds=drive.wheel_speeds,
    )


def fitted(record, file, seconds):
    """The fit to the first 60 % of a record."""
    train, rest = map(tuple, divide([record], 0.6))
    data = LogData(train, rest, ("drive",), "the rest", "gyro", (), ())
    runs = joined(sensed(train))
    beside = identified(identify_data(data, STRUCTURES["sm"], "drive").content, runs)
    nominal = nominal_robot("drive", train, file)
    space = space_of(nominal, beside.effects, gyro=True, lagging=False)
    return fit_twin(TwinProblem(space, most_telling(runs, beside.model.dc_gain, seconds)), beside.start(nominal))


def in_terms_of(fit, truth):
    """The truth in the units of the fit's parameters."""
    robot = fit.space.nominal.robot
    return truth | {
        "mass": truth["mass"] / robot.robot.mass,
        "wheel_base": truth["wheel_base"] / robot.twin.chassis.wheel_base,
        "track": truth["track"] / fit.space.nominal.track_of_encoders,
    }
