"""Plans driven on the simulated robot, by the controller and open loop; energy by what each motor really did."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.pose import wrap_angle
from diffdrive_mpc.models.turn_costs import load_drive_constants, load_vehicle
from diffdrive_mpc.mpc import Controller, load_config
from diffdrive_mpc.sim import simulate
from diffdrive_mpc.sim.metrics.tracking_errors import tracking_errors
from diffdrive_mpc.sim.plants.open_loop import drive_open_loop
from studies.saving.settings import SavingStudySettings, Standing
from studies.torque.measurements import plant_of

if TYPE_CHECKING:
    from diffdrive_mpc.extras.planner import Plan

_KEPT = 400
_ARRIVED = 0.1


class Driven(NamedTuple):
    """One plan and what became of it."""

    length: float
    """of the plan [m]"""
    duration: float
    """of the plan [s]"""
    predicted: float
    """energy by the plan [J]"""
    measured: float
    """energy until the robot stands [J], by true torque and speed of each motor, step by step of the physics"""
    seconds: float
    """until it stands [s]"""
    position: float
    """from the end of the plan [m], where it stands"""
    heading: float
    """from that of the end of the plan [rad], absolute"""
    lateral: float
    """RMSE from the path [m]"""
    saturated: float
    """share of the time in which a motor gives 95 % of its limit or more [-]"""
    arrived: bool
    """whether it stands, within a decimetre of the end"""
    planned: FloatArray
    """(k, 3) poses of the plan"""
    path: FloatArray
    """(k, 3) true poses"""

    @property
    def error(self) -> float:
        """Of the prediction, over what was measured [-]."""
        return self.predicted / self.measured - 1


def drive_closed(
    asked: SavingStudySettings, plan: Plan, surface: str, payload: float = 0.0, *, beside: float = 0.0
) -> Driven:
    """Drive a plan with the controller, always the same one, from the same start and with the same noise.

    `beside` is drawn by others than the motors until the robot stands [W].
    """
    config = load_config(asked.configuration)
    plant = plant_of(asked.robot, surface, payload, seed=asked.seed)
    run = simulate(Controller(config), plant, plan.trajectory, extra_time=asked.standing.wait)
    rows = (run.true_pose, run.true_twist, run.motor_torque, run.motor_power, run.motor_square)
    return _judged(asked, plan, rows, run.sample_time, run.ended, beside)


def drive_open(asked: SavingStudySettings, plan: Plan, surface: str, payload: float = 0.0) -> Driven:
    """Send the commands of a plan and nothing else, as P4 does; then stand still for a while."""
    plant = plant_of(asked.robot, surface, payload, seed=asked.seed)
    ticks = np.arange(0.0, plan.duration + asked.standing.wait, plant.sample_time)
    at = np.minimum((ticks / plan.sample_time).astype(int), len(plan.commands))
    commands = np.vstack([plan.commands, np.zeros(2)])[at]
    drive = drive_open_loop(plant, commands, plan.trajectory.sample([0.0]).pose[0])
    rows = (drive.true_pose, drive.true_twist, drive.motor_torque, drive.motor_power, drive.motor_square)
    return _judged(asked, plan, rows, plant.sample_time, "")


def standing_from(twist: FloatArray, asked: Standing) -> int:
    """First row of (n, 3) forward, lateral speed and yaw rate from which on the robot stands for good; n for never."""
    moving = (np.abs(twist[:, :2]).max(axis=1) > asked.speed) | (np.abs(twist[:, 2]) > asked.yaw_rate)
    last = np.flatnonzero(moving)
    return int(last[-1]) + 1 if last.size else 0


def _judged(
    asked: SavingStudySettings,
    plan: Plan,
    rows: tuple[FloatArray, ...],
    sample_time: float,
    ended: str,
    beside: float = 0.0,
) -> Driven:
    constants, limit = load_drive_constants(asked.robot), 0.5 * load_vehicle(asked.robot).torque_limit
    pose, twist, torque, power, square = rows
    count = standing_from(twist, asked.standing)
    stands = count < len(pose) and not ended
    goal = plan.trajectory.sample([plan.trajectory.duration]).pose[0]
    end = pose[min(count, len(pose) - 1)]
    used = np.isfinite(power).all(axis=1) & (np.arange(len(power)) < count)
    idle = constants.idle_power + beside
    drawn = constants.motor_power(power[used], square[used]).sum() + idle * np.count_nonzero(used)
    expected = plan.trajectory.sample(np.arange(len(pose)) * sample_time)
    errors = tracking_errors(plan.trajectory, expected, pose, twist)
    away = float(np.hypot(*(end - goal)[:2]))
    kept = np.unique(np.linspace(0, max(count - 1, 0), _KEPT).astype(int))
    along = plan.trajectory.sample(np.linspace(0.0, plan.trajectory.duration, _KEPT)).pose
    return Driven(
        plan.length,
        plan.duration,
        plan.energy,
        float(drawn * sample_time),
        count * sample_time,
        away,
        abs(float(wrap_angle(end[2] - goal[2]))),
        float(np.sqrt(np.mean(errors.lateral[: max(count, 1)] ** 2))),
        float(np.mean(np.abs(torque[used]).max(axis=1) >= 0.95 * limit)) if used.any() else 0.0,
        bool(stands and away < _ARRIVED),
        along,
        pose[kept],
    )
