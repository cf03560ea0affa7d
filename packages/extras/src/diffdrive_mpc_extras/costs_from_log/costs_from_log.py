"""Drive constants, torque curves and slip law of a robot, from a log of battery readings and motor currents."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs import Log, read_log
from diffdrive_mpc.models.logs.record import BoolArray, Record
from diffdrive_mpc_extras.energy import IdentifiedConstants, identify_constants
from diffdrive_mpc_extras.terrain import load_terrain
from diffdrive_mpc_extras.torque import TorqueCurves, load_torque_settings
from diffdrive_mpc_extras.torque.torque_curves import costs_of_curves
from diffdrive_mpc_extras.turn_costs import (
    DriveConstants,
    IdentifiedSlip,
    TurnCosts,
    Vehicle,
    identify_slip,
    load_drive_constants,
    load_vehicle,
)
from diffdrive_mpc_extras.turn_costs.slip import body_twists

PRIOR = "vinyl"
"""Terrain of the initial torque curves: published values, chosen to differ from the robot's."""

# Absolute [m/s, rad/s] and relative tolerance within which a command counts as constant.
_COMMAND_TOLERANCE, _RELATIVE_TOLERANCE = 0.02, 0.05
_MIN_SAMPLES = 200
# Minimum ratio of the largest to the smallest radius in the log for which curves are learned.
_MIN_RADIUS_RATIO = 3.0
# Time between the two poses that determine a twist, and between the starts of consecutive twists [s].
_POSE_INTERVAL = 1.0
_START_INTERVAL = 0.1


class LogOutcome(NamedTuple):
    """Result of learning from a log."""

    log: Log
    vehicle: Vehicle
    drive: DriveConstants
    """Drive constants that convert motor currents to torques."""
    identified: IdentifiedConstants | None
    """Identification of the constants; None if the given constants are used."""
    prior: DriveConstants
    """Drive constants before the identification."""
    note: str
    """Reason why the given constants are used; empty after an identification."""
    samples: FloatArray
    """(n, 3) commanded radius at the speed of the curves [m], torque of the outer and of the inner side [N m]."""
    curves: TorqueCurves
    slip: IdentifiedSlip | None
    slip_source: str
    """Source of the slip law, or the reason why there is none."""
    costs: TurnCosts
    measured: float
    """Battery energy at rest and in turns of at least the minimum radius [J]; NaN if no battery was logged."""
    predicted: float
    """Energy that the turn costs predict for the same commands [J]."""


def learn_log(log: str | Path, mapping: str | Path | None, vehicle: str | Path, drive: str | Path | None) -> LogOutcome:
    """Identify the drive constants, then learn the torque curves, then identify the slip law.

    Parameters
    ----------
    log, mapping
        As for `models.logs.read_log`; the mapping names `motors`, and `battery` for the constants.
    vehicle
        Shipped name or file.
    drive
        Initial constants, shipped name or file. Gears and number of motors are always taken from here. The default is
        the papers' robot; the log must then determine torque constant and resistance.

    Raises
    ------
    models.checked_yaml.ConfigError
        If a file cannot be used, the log has no motor currents, the log does not determine the constants and `drive` is
        None, or there are too few steady turns.
    """
    loaded_vehicle, prior = load_vehicle(vehicle), load_drive_constants(drive or "default")
    robot_log = read_log(log, mapping)
    records = robot_log.records
    if any(record.motor_current is None for record in records):
        raise ConfigError(
            f"{robot_log.name}: no motor currents; name their columns or topics as 'motors' in the mapping"
        )
    identified, constants, note = None, prior, ""
    try:
        identified = identify_constants(records, prior)
        constants = identified.constants
    except ConfigError as error:
        if drive is None:
            raise ConfigError(
                f"{error}; or pass --drive with the constants that convert currents to torques"
            ) from error
        note = str(error)
    curves = TorqueCurves.from_prior(loaded_vehicle, load_terrain(PRIOR).model_copy(update={"slip": None}))
    parts = [_learn(curves, record, constants) for record in records]
    samples = np.concatenate(parts)
    radii = samples[:, 0]
    low, high = (float(radii.min()), float(radii.max())) if len(radii) else (1.0, 1.0)
    if len(radii) < _MIN_SAMPLES or high < _MIN_RADIUS_RATIO * low:
        raise ConfigError(
            f"{robot_log.name}: {len(radii)} samples of steady turns, radii of {low:.2g} to {high:.2g} m; drive turns "
            f"from sharp to wide, each held for some seconds, with at least {_MIN_SAMPLES} samples after settling"
        )
    slip, slip_source = _slip(records, curves)
    rows = np.zeros((3, 3)) if slip is None else slip.coefficients
    sources = f"{len(radii)} samples of steady turns; {slip_source}"
    bounds = load_torque_settings().curves.radii
    costs = costs_of_curves(
        curves,
        rows,
        name=f"{loaded_vehicle.name}, {robot_log.name}",
        vehicle=loaded_vehicle,
        drive=constants,
        provenance=f"from the log {robot_log.name} by 'diffdrive-mpc torque': {sources}",
        radii=(max(low, bounds[0]), min(high, bounds[1])),
    )
    min_radius = curves.least_radius()
    energies = np.sum([_energies(record, costs, min_radius) for record in records], axis=0).tolist()
    identification = loaded_vehicle, constants, identified, prior, note
    return LogOutcome(robot_log, *identification, samples, curves, slip, slip_source, costs, *energies)


def is_settled(commands: FloatArray, dt: float, settling: float) -> BoolArray:
    """Return (n,) True if a command (n, 2) has been constant, within the tolerances, for `settling` [s]."""
    from scipy.ndimage import maximum_filter1d, minimum_filter1d  # noqa: PLC0415 - loads slowly

    count = max(1, round(settling / dt))
    # The window contains the previous `count` samples and the current sample.
    window = {"size": count + 1, "axis": 0, "mode": "nearest", "origin": count - (count + 1) // 2}
    spread = maximum_filter1d(commands, **window) - minimum_filter1d(commands, **window)
    is_constant = (spread <= _COMMAND_TOLERANCE + _RELATIVE_TOLERANCE * np.abs(commands)).all(axis=1)
    is_constant[:count] = False
    return np.asarray(is_constant)


def _learn(curves: TorqueCurves, record: Record, drive: DriveConstants) -> FloatArray:
    """Update the curves with a record, and return the samples used, as in `LogOutcome.samples`."""
    assert record.motor_current is not None
    curve_settings, rows = load_torque_settings().curves, record.command
    torques = drive.torque_per_current * record.motor_current
    # The curves hold for forward turns only: exclude rest, reverse motion and turns on the spot.
    mask = is_settled(rows, record.dt, curve_settings.settling) & (rows[:, 0] > 0) & np.isfinite(torques).all(axis=1)
    mask &= rows[:, 1] != 0
    curves.learn_drive(rows, torques[:, 0], torques[:, 1], record.dt, settled=mask)
    v, omega = rows[mask].T
    turns_right = omega < 0
    outer, inner = (np.where(turns_right, torques[mask, k], torques[mask, 1 - k]) for k in (0, 1))
    return np.stack([_equivalent_radius(v, omega), outer, inner], axis=-1)


def _equivalent_radius(v: FloatArray, omega: FloatArray) -> FloatArray:
    """Compute the radius [m] that requires, at the speed of the curves, the same torque as these commands."""
    curve_settings = load_torque_settings().curves
    return np.abs(v / omega) * (curve_settings.speed / np.abs(v)) ** curve_settings.speed_exponent


def _slip(records: Sequence[Record], curves: TorqueCurves) -> tuple[IdentifiedSlip | None, str]:
    """Identify the slip law from poses and gyro, or from the gyro only, in turns of at least the minimum radius."""
    commands, twists, source = [], [], ""
    for record in records:
        step, stride = (max(1, round(time / record.dt)) for time in (_POSE_INTERVAL, _START_INTERVAL))
        settled = is_settled(record.command, record.dt, load_torque_settings().curves.settling)
        # An interval counts if all of its samples are settled.
        candidates = range(0, len(settled) - step, stride)
        starts = [k for k in candidates if settled[k : k + step + 1].all() and record.command[k, 0]]
        rows = record.command[starts]
        if record.pose is None and record.yaw_rate is None:
            return None, "no slip law: the log has neither poses nor a gyro"
        source = "slip of the yaw rate from the gyro; longitudinal and lateral slip are unknown and set to zero"
        body = np.stack([rows[:, 0], np.zeros(len(rows)), np.full(len(rows), np.nan)], axis=-1)
        if record.pose is not None:
            source = "slip law from poses"
            body = body_twists(record.pose[starts], record.pose[[k + step for k in starts]], step * record.dt)
        if record.yaw_rate is not None and starts:
            source += " and the gyro" if record.pose is not None else ""
            # The mean of the gyro over a second is more accurate than the difference of two headings.
            body[:, 2] = [record.yaw_rate[k : k + step].mean() for k in starts]
        twists.append(body)
        commands.append(rows)
    rows, measured = np.concatenate(commands), np.concatenate(twists)
    with np.errstate(divide="ignore", invalid="ignore"):
        is_wide = _equivalent_radius(rows[:, 0], rows[:, 1]) >= curves.least_radius()
    try:
        return identify_slip(rows, measured, used=is_wide), source
    except ConfigError as error:
        return None, f"no slip law: {error}"


def _energies(record: Record, costs: TurnCosts, min_radius: float) -> tuple[float, float]:
    """Compute measured and predicted energy [J] of the samples with a battery reading, without sharper turns."""
    v, omega = record.command.T
    with np.errstate(divide="ignore", invalid="ignore"):
        mask = ~(_equivalent_radius(v, omega) < min_radius)
    predicted = costs.power(record.command)
    if record.battery is None:
        return math.nan, float(predicted[mask].sum() * record.dt)
    battery_power = record.battery.prod(axis=1)
    mask &= np.isfinite(battery_power)
    return float(battery_power[mask].sum() * record.dt), float(predicted[mask].sum() * record.dt)
