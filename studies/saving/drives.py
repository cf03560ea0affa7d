"""Plans driven on the simulated robot, by the controller and open loop; energy by what each motor really did."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from diffdrive_mpc.bench.statistics import BootstrapEstimate, mean
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.pose import wrap_angle
from diffdrive_mpc.mpc import Controller, load_config
from diffdrive_mpc.sim import simulate
from diffdrive_mpc.sim.metrics.tracking_errors import tracking_errors
from diffdrive_mpc.sim.plants.open_loop import drive_open_loop
from diffdrive_mpc_extras.planner import Objective, PlanError, plan, plan_each
from diffdrive_mpc_extras.turn_costs import load_drive_constants, load_turn_costs, load_vehicle
from studies.saving.settings import Pair, SavingStudySettings, Standstill
from studies.torque.measurements import plant_of

if TYPE_CHECKING:
    from diffdrive_mpc_extras.planner import Plan


_KEPT = 400
_ARRIVED = 0.1


class PlanDrive(NamedTuple):
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
    settings: SavingStudySettings, plan: Plan, surface: str, payload: float = 0.0, *, beside: float = 0.0
) -> PlanDrive:
    """Drive a plan with the controller, always the same one, from the same start and with the same noise.

    `beside` is drawn by others than the motors until the robot stands [W].
    """
    config = load_config(settings.configuration)
    plant = plant_of(settings.robot, surface, payload, seed=settings.seed)
    run = simulate(Controller(config), plant, plan.trajectory, extra_time=settings.standing.wait)
    rows = (run.true_pose, run.true_twist, run.motor_torque, run.motor_power, run.motor_square)
    return _judged(settings, plan, rows, run.sample_time, run.ended, beside)


def drive_open(settings: SavingStudySettings, plan: Plan, surface: str, payload: float = 0.0) -> PlanDrive:
    """Send the commands of a plan and nothing else, as P4 does; then stand still for a while."""
    plant = plant_of(settings.robot, surface, payload, seed=settings.seed)
    ticks = np.arange(0.0, plan.duration + settings.standing.wait, plant.sample_time)
    at = np.minimum((ticks / plan.sample_time).astype(int), len(plan.commands))
    commands = np.vstack([plan.commands, np.zeros(2)])[at]
    drive = drive_open_loop(plant, commands, plan.trajectory.sample([0.0]).pose[0])
    rows = (drive.true_pose, drive.true_twist, drive.motor_torque, drive.motor_power, drive.motor_square)
    return _judged(settings, plan, rows, plant.sample_time, "")


def standing_from(twist: FloatArray, standstill: Standstill) -> int:
    """First row of (n, 3) forward, lateral speed and yaw rate from which on the robot stands for good; n for never."""
    moving = (np.abs(twist[:, :2]).max(axis=1) > standstill.speed) | (np.abs(twist[:, 2]) > standstill.yaw_rate)
    last = np.flatnonzero(moving)
    return int(last[-1]) + 1 if last.size else 0


def _judged(
    settings: SavingStudySettings,
    plan: Plan,
    rows: tuple[FloatArray, ...],
    sample_time: float,
    ended: str,
    beside: float = 0.0,
) -> PlanDrive:
    constants, limit = load_drive_constants(settings.robot), 0.5 * load_vehicle(settings.robot).torque_limit
    pose, twist, torque, power, square = rows
    count = standing_from(twist, settings.standing)
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
    return PlanDrive(
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


# Each pair planned and driven for energy, for distance and for time; what was saved, pair by pair.


AIMS: tuple[Objective, ...] = ("energy", "distance", "time")
"""What is made least, in the order of the tables."""


class PairOutcome(NamedTuple):
    """One pair on one floor."""

    surface: str
    number: int
    pair: Pair
    drives: Mapping[Objective, PlanDrive]
    """By aim; none where there is no plan"""
    fed: PlanDrive | None
    """energy-optimal where a computer on board is fed as long as it lasts; its energy has both"""
    told: str
    """Why there is no plan; empty where there is one for each aim"""

    def saving(self, over: Objective = "distance", *, computer: float = 0.0) -> float:
        """Energy that the energy-optimal drive takes less than another, over that of the other [-]; NaN without both.

        Of drives that did not arrive nothing is said. `computer` is power that is drawn all the time beside [W].
        """
        own, other = self.drives.get("energy"), self.drives.get(over)
        if own is None or other is None or not (own.arrived and other.arrived):
            return math.nan
        return 1 - (own.measured + computer * own.seconds) / (other.measured + computer * other.seconds)

    def saving_fed(self, computer: float) -> float:
        """What the energy-optimal drive takes less than the distance-optimal [-], where a computer draws so much [W].

        The first was planned with the computer; NaN as above.
        """
        other = self.drives.get("distance")
        if self.fed is None or other is None or not (self.fed.arrived and other.arrived):
            return math.nan
        return 1 - self.fed.measured / (other.measured + computer * other.seconds)

    def promised(self, over: Objective = "distance") -> float:
        """The same by the plans [-]."""
        return 1 - self.drives["energy"].predicted / self.drives[over].predicted


def measure_pair(asked: SavingStudySettings, surface: str, number: int, pair: Pair) -> PairOutcome:
    """Plan and drive one pair, for each aim by the same rules: cap of speed, ramps, controller, floor, noise."""
    costs, settings = load_turn_costs(asked.costs_of(surface)), asked.planning.settings
    try:
        plans = plan_each(costs, pair.start, pair.goal, speed=asked.speed, settings=settings)
        with_computer = costs.with_idle_power(costs.drive.idle_power + asked.computer)
        fed = plan(with_computer, pair.start, pair.goal, speed=asked.speed, settings=settings)
    except PlanError as error:
        return PairOutcome(surface, number, pair, {}, None, str(error))
    drives = {aim: drive_closed(asked, plans[aim], surface) for aim in AIMS}
    beside = drive_closed(asked, fed, surface, beside=asked.computer)
    return PairOutcome(surface, number, pair, drives, beside, "")


class Saved(NamedTuple):
    """What was saved on one floor, over its pairs; means with bootstrap intervals."""

    pairs: int
    """for which both drives arrived"""
    mean: BootstrapEstimate
    """over the savings of the pairs [-]"""
    total: float
    """of the sum of all drives [-]"""
    least: float
    most: float
    worse: int
    """pairs whose energy-optimal drive took more"""
    predicted: float
    """mean saving by the plans [-]"""

    @classmethod
    def of(cls, outcomes: Sequence[PairOutcome], over: Objective = "distance") -> Saved:
        """Of the pairs of a floor."""
        both = [outcome for outcome in outcomes if math.isfinite(outcome.saving(over))]
        savings = np.array([one.saving(over) for one in both])
        if not both:
            return cls(0, BootstrapEstimate.of_runs([], mean), math.nan, math.nan, math.nan, 0, math.nan)
        own, other = (sum(one.drives[aim].measured for one in both) for aim in ("energy", over))
        return cls(
            len(both),
            BootstrapEstimate.of_runs(savings, mean),
            1 - own / other,
            float(savings.min()),
            float(savings.max()),
            int(np.count_nonzero(savings < 0)),
            float(np.mean([one.promised(over) for one in both])),
        )


def worse_arrival(outcomes: Sequence[PairOutcome]) -> tuple[BootstrapEstimate, BootstrapEstimate]:
    """By how much the energy-optimal drive ends further off than the distance-optimal: position [m], heading [rad]."""
    both = [outcome for outcome in outcomes if {"energy", "distance"} <= {*outcome.drives}]

    def differences(what: str) -> FloatArray:
        return np.array([getattr(one.drives["energy"], what) - getattr(one.drives["distance"], what) for one in both])

    return BootstrapEstimate.of_runs(differences("position"), mean), BootstrapEstimate.of_runs(
        differences("heading"), mean
    )
