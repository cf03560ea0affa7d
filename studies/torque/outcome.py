"""What is measured, learned and predicted on one floor."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.sim.plants.open_loop import OpenLoopDrive, drive_open_loop
from diffdrive_mpc_extras.energy import predict_energy
from diffdrive_mpc_extras.energy.power_readings import robot_power
from diffdrive_mpc_extras.terrain import FittedShear, Terrain, fit_shear, load_terrain, side_torques
from diffdrive_mpc_extras.torque import TorqueCurves, TorqueSettings, load_torque_settings
from diffdrive_mpc_extras.torque.torque_curves import costs_of_curves
from diffdrive_mpc_extras.turn_costs import (
    DriveConstants,
    IdentifiedSlip,
    TurnCosts,
    Vehicle,
    identify_slip,
    least_radius,
    load_vehicle,
)
from studies.torque.measurements import (
    Steady,
    diagnostic_drive,
    own_least_radius,
    plant_of,
    sides,
    steady_turns,
    unseen_commands,
)
from studies.torque.settings import TorqueStudySettings

CLOSE = 0.10
"""RMSE over the RMS of the measured curve below which a curve counts as learned."""

_LOOK_EVERY = 1.0
_FLOOR = Terrain(description="the floor of the simulated robot")


class EnergyOf(NamedTuple):
    """One unseen drive."""

    seed: int
    measured: float
    """[J] by the true torques of the motors, physics step by physics step"""
    predicted: float
    """[J] by the learned curves"""
    by_prior: float
    """[J] by the curves of the prior"""

    @property
    def error(self) -> float:
        """Of the prediction, over what was measured [-]."""
        return self.predicted / self.measured - 1


class FloorOutcome(NamedTuple):
    """One floor."""

    surface: str
    steady: dict[float, Steady]
    """By speed"""
    drive: OpenLoopDrive
    prior: TorqueCurves
    learned: TorqueCurves
    learned_by_radius: float
    """RMSE where speed does not count, as in P4, over the RMS of the curve [-]"""
    history: FloatArray
    """(k, 2) time in the drive [s], RMSE of both sides together over the RMS of the curve"""
    fitted: FittedShear
    """From steady turns at the radii that are held out from the curve"""
    mapped: FittedShear
    """From the learned curves, equation 24"""
    own_radius: tuple[float, float]
    """[m] of the robot itself: by torque, by turns not kept"""
    model_radius: float
    learned_radius: float
    energies: tuple[EnergyOf, ...]
    costs: TurnCosts
    """What planner and controller read: slip law and learned curves of the diagnostic drive"""
    slip: IdentifiedSlip

    @property
    def close_after(self) -> float:
        """Time in the drive from which on the RMSE is below `CLOSE` [s]; infinity where it is not at the end."""
        far = np.flatnonzero(self.history[:, 1] > CLOSE)
        if far.size and far[-1] == len(self.history) - 1:
            return math.inf
        return float(self.history[far[-1] + 1, 0]) if far.size else 0.0


class PayloadOutcome(NamedTuple):
    """Torques under one payload, at one speed."""

    payload: float
    steady: Steady
    predicted: FloatArray
    """(n, 2) outer, inner [N m], of the terrain that was mapped from what was learned without payload"""
    learned: FloatArray
    """(n, 2) what was learned without payload says"""


def parts_of(study: TorqueStudySettings) -> tuple[Vehicle, DriveConstants]:
    """Vehicle and motors of the robot; raises ConfigError where it or a vehicle of its name does not exist."""
    return load_vehicle(study.vehicle or study.robot), robot_power(f"mujoco:{study.robot}").drive


def reference_speed() -> float:
    """At which curves stand [m/s]."""
    return load_torque_settings().curves.speed


def rms_error(curves: TorqueCurves, steady: Steady, speed: float) -> tuple[float, float]:
    """RMSE of outer and inner side, over the RMS of each measured curve [-]."""
    pairs = ((curves.outer(steady.radius, speed), steady.outer), (curves.inner(steady.radius, speed), steady.inner))
    outer, inner = (float(np.sqrt(np.mean((estimate - true) ** 2) / np.mean(true**2))) for estimate, true in pairs)
    return outer, inner


def measure_floor(study: TorqueStudySettings, surface: str) -> FloorOutcome:
    """Measure, learn, map and predict on one floor."""
    vehicle, constants = parts_of(study)
    track, speed = vehicle.command_track or vehicle.track, reference_speed()
    still = plant_of(study.robot, surface, sensors="perfect")
    speeds = sorted({*study.measured.speeds, speed})
    steady = {v: steady_turns(still, study.measured.radii, v, study.measured, track) for v in speeds}
    held_out = steady_turns(still, study.fit_radii, speed, study.measured, track)
    drive = diagnostic_drive(plant_of(study.robot, surface, seed=study.seed), study.diagnostic)
    prior = TorqueCurves.from_prior(vehicle, load_terrain(study.prior))
    learned, history = _learned(vehicle, study, drive, still.sample_time, steady[speed], speed)
    by_radius, _ = _learned(
        vehicle, study, drive, still.sample_time, steady[speed], speed, _with_exponent(load_torque_settings(), 0.0)
    )
    free = held_out.outer < study.saturated * vehicle.torque_limit
    rows = (held_out.radius[free], speed, held_out.outer[free], held_out.inner[free])
    fitted = fit_shear(vehicle, _FLOOR, *rows, one_friction=True)
    mapped = map_back(study, vehicle, learned, speed)
    model = fitted.on(_FLOOR)
    energies = []
    for seed in study.unseen.seeds:
        least = learned.least_radius(max(study.unseen.speeds))
        commands = unseen_commands(study.unseen, seed, still.sample_time, least if math.isfinite(least) else 0.0)
        driven = drive_open_loop(plant_of(study.robot, surface, seed=study.seed), commands)
        predicted, by_prior = (
            predict_energy(vehicle, constants, curves, commands, still.sample_time).energy
            for curves in (learned, prior)
        )
        energies.append(EnergyOf(seed, true_energy(driven, constants, still.sample_time), predicted, by_prior))
    return FloorOutcome(
        surface,
        steady,
        drive,
        prior,
        learned,
        max(rms_error(by_radius, steady[speed], speed)),
        history,
        fitted,
        mapped,
        own_least_radius(still, speed, study.measured, vehicle.torque_limit, track),
        least_radius(lambda radii: side_torques(vehicle, model, radii, speed).outer, vehicle.torque_limit),
        learned.least_radius(),
        tuple(energies),
        *turn_costs_of(study, surface, vehicle, constants, learned, drive, still.sample_time),
    )


def turn_costs_of(
    study: TorqueStudySettings,
    surface: str,
    vehicle: Vehicle,
    constants: DriveConstants,
    learned: TorqueCurves,
    drive: OpenLoopDrive,
    sample_time: float,
) -> tuple[TurnCosts, IdentifiedSlip]:
    """The file of this robot on this floor, and how well its slip law is known.

    The law is that of turns no sharper than the learned least radius: beyond it the wheels do not do what the
    base asks.
    """
    settings = load_torque_settings().curves
    v, omega = drive.command.T
    same = np.abs(v / omega) * (settings.speed / np.abs(v)) ** settings.speed_exponent
    kept = same >= learned.least_radius()
    slip = identify_slip(drive.command, drive.true_twist, sample_time, settings.settling, kept)
    words = (
        f"simulated robot '{study.robot}' on surface '{surface}', diagnostic drive of {len(v) * sample_time:.0f} s by "
        f"'python -m studies torque': learned torques; slip law from the true twist of {slip.rows} samples no "
        "sharper than the least radius. Below that radius the torque is at its limit, and the robot slips more than "
        "the law says"
    )
    radii = (float(same.min()), float(min(same.max(), settings.radii[1])))
    name = f"{study.robot}-{surface}"
    costs = costs_of_curves(
        learned, slip.coefficients, name=name, vehicle=vehicle, drive=constants, provenance=words, radii=radii
    )
    return costs, slip


def true_energy(drive: OpenLoopDrive, constants: DriveConstants, sample_time: float) -> float:
    """What the battery gave for a drive [J], from what each motor really did."""
    return float(true_power(drive, constants).sum() * sample_time)


def true_power(drive: OpenLoopDrive, constants: DriveConstants) -> FloatArray:
    """(K,) what the battery gave in each sample [W], as `true_energy`."""
    return np.asarray(constants.motor_power(drive.motor_power, drive.motor_square).sum(axis=1) + constants.idle_power)


def map_back(study: TorqueStudySettings, vehicle: Vehicle, curves: TorqueCurves, speed: float) -> FittedShear:
    """The terrain that says what was learned (equation 24), where the torque is that of the floor."""
    radii = np.array(study.fit_radii)
    outer, inner = curves.outer(radii, speed), curves.inner(radii, speed)
    free = outer < study.saturated * vehicle.torque_limit
    return fit_shear(vehicle, _FLOOR, radii[free], speed, outer[free], inner[free], one_friction=True)


def measure_payload(study: TorqueStudySettings, payload: float) -> PayloadOutcome:
    """Steady turns under a payload, beside what follows from a diagnostic drive without it."""
    vehicle, _ = parts_of(study)
    track, speed = vehicle.command_track or vehicle.track, reference_speed()
    plant = plant_of(study.robot, study.payload_surface, seed=study.seed)
    drive = diagnostic_drive(plant, study.diagnostic)
    empty = plant_of(study.robot, study.payload_surface, sensors="perfect")
    curves = TorqueCurves.from_prior(vehicle, load_terrain(study.prior))
    curves.learn_drive(drive.command, *sides(drive.motor_torque), plant.sample_time)
    ground = map_back(study, vehicle, curves, speed).on(_FLOOR)
    loaded = plant_of(study.robot, study.payload_surface, payload, sensors="perfect") if payload else empty
    steady = steady_turns(loaded, study.measured.radii, speed, study.measured, track)
    torques = side_torques(vehicle.carrying(payload), ground, steady.radius, speed)
    limit = vehicle.torque_limit
    return PayloadOutcome(
        payload,
        steady,
        np.clip(np.stack([torques.outer, torques.inner], -1), -limit, limit),
        np.stack([curves.outer(steady.radius, speed), curves.inner(steady.radius, speed)], -1),
    )


def _learned(
    vehicle: Vehicle,
    study: TorqueStudySettings,
    drive: OpenLoopDrive,
    sample_time: float,
    steady: Steady,
    speed: float,
    settings: TorqueSettings | None = None,
) -> tuple[TorqueCurves, FloatArray]:
    """Curves after the drive, from the prior; and how far they were off meanwhile."""
    curves = TorqueCurves.from_prior(vehicle, load_terrain(study.prior), settings)
    every, looks = max(1, round(_LOOK_EVERY / sample_time)), [(0.0, max(rms_error(curves, steady, speed)))]

    def look(k: int) -> None:
        if k % every == 0:
            looks.append(((k + 1) * sample_time, max(rms_error(curves, steady, speed))))

    left, right = sides(drive.motor_torque)
    curves.learn_drive(drive.command, left, right, sample_time, look)
    looks.append((len(drive.command) * sample_time, max(rms_error(curves, steady, speed))))
    return curves, np.array(looks)


def _with_exponent(settings: TorqueSettings, value: float) -> TorqueSettings:
    return settings.model_copy(update={"curves": settings.curves.model_copy(update={"speed_exponent": value})})
