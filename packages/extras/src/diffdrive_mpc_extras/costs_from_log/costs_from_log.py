"""Drive constants, torque curves and slip law of a robot from a log with its battery and the currents of its motors."""

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
"""The terrain that the curves know before the log: published, and wrong on purpose."""

# A command counts as held within this difference [m/s, rad/s], plus this part of the command.
_HELD, _HELD_SHARE = 0.02, 0.05
_LEAST_ROWS = 200
# Least ratio of greatest to smallest radius of the log for a curve.
_LEAST_RANGE = 3.0
# Time between the poses [s] that determine a twist.
_BETWEEN_POSES = 1.0
_EVERY = 0.1


class LogOutcome(NamedTuple):
    """Result from the log."""

    log: Log
    vehicle: Vehicle
    drive: DriveConstants
    """By which currents are torques"""
    identified: IdentifiedConstants | None
    """Identification of the constants; None if the given ones are used."""
    prior: DriveConstants
    note: str
    """Reason for the given constants; empty after an identification."""
    samples: FloatArray
    """(n, 3) commanded radius at the speed of the curves [m], torque of the outer and of the inner side [N m]"""
    curves: TorqueCurves
    slip: IdentifiedSlip | None
    slip_from: str
    """Source of the slip law, or the reason for its absence."""
    costs: TurnCosts
    measured: float
    """Energy of the battery in turns no sharper than the least radius, and at rest [J]; NaN without a battery."""
    predicted: float
    """Energy predicted by the turn costs for the same commands [J]."""


def learn_log(log: str | Path, mapping: str | Path | None, vehicle: str | Path, drive: str | Path | None) -> LogOutcome:
    """Identify and learn, in this order: constants, torque curves, slip law.

    Parameters
    ----------
    log, mapping
        As for `models.logs.read_log`; the mapping names `motors`, and `battery` for the constants.
    vehicle
        Shipped name or file.
    drive
        Constants to begin with, shipped name or file: gears and number of motors are theirs in any case. By default
        those of the papers' robot, and then the log must determine torque constant and resistance.

    Raises
    ------
    models.checked_yaml.ConfigError
        If a file cannot be used, the log has no motors, does not tell the constants where no drive is given, or holds
        too few steady turns.
    """
    car, prior = load_vehicle(vehicle), load_drive_constants(drive or "default")
    read = read_log(log, mapping)
    records = read.records
    if any(record.motor_current is None for record in records):
        raise ConfigError(
            f"{read.name}: no currents of the motors; name their columns or topics, 'motors', in the mapping"
        )
    identified, constants, note = None, prior, ""
    try:
        identified = identify_constants(records, prior)
        constants = identified.constants
    except ConfigError as error:
        if drive is None:
            raise ConfigError(
                f"{error}; or give --drive with the constants that convert currents to torques"
            ) from error
        note = str(error)
    curves = TorqueCurves.from_prior(car, load_terrain(PRIOR).model_copy(update={"slip": None}))
    parts = [_learn(curves, record, constants) for record in records]
    samples = np.concatenate(parts)
    radii = samples[:, 0]
    low, high = (float(radii.min()), float(radii.max())) if len(radii) else (1.0, 1.0)
    if len(radii) < _LEAST_ROWS or high < _LEAST_RANGE * low:
        raise ConfigError(
            f"{read.name}: {len(radii)} samples of steady turns, radii of {low:.2g} to {high:.2g} m; drive turns from "
            f"sharp to wide, each held for some seconds, {_LEAST_ROWS} samples or more after they have settled"
        )
    slip, slip_from = _slip(records, curves)
    rows = np.zeros((3, 3)) if slip is None else slip.coefficients
    words = f"from the log {read.name} by 'diffdrive-mpc torque': {len(radii)} samples of steady turns; {slip_from}"
    bounds = load_torque_settings().curves.radii
    costs = costs_of_curves(
        curves,
        rows,
        name=f"{car.name}, {read.name}",
        vehicle=car,
        drive=constants,
        provenance=words,
        radii=(max(low, bounds[0]), min(high, bounds[1])),
    )
    least = curves.least_radius()
    energies = np.sum([_energies(record, costs, least) for record in records], axis=0).tolist()
    return LogOutcome(read, car, constants, identified, prior, note, samples, curves, slip, slip_from, costs, *energies)


def settled(commands: FloatArray, dt: float, settling: float) -> BoolArray:
    """Return (n,) True if a command (n, 2) has been held for `settling` [s], apart from small changes."""
    from scipy.ndimage import maximum_filter1d, minimum_filter1d  # noqa: PLC0415 - loads slowly

    count = max(1, round(settling / dt))
    # Of the last `count` samples and this one.
    around = {"size": count + 1, "axis": 0, "mode": "nearest", "origin": count - (count + 1) // 2}
    spread = maximum_filter1d(commands, **around) - minimum_filter1d(commands, **around)
    held = (spread <= _HELD + _HELD_SHARE * np.abs(commands)).all(axis=1)
    held[:count] = False
    return np.asarray(held)


def _learn(curves: TorqueCurves, record: Record, drive: DriveConstants) -> FloatArray:
    """Take in a record; the samples that were used, as `LogOutcome.samples`."""
    assert record.motor_current is not None
    curve_settings, rows = load_torque_settings().curves, record.command
    torques = drive.torque_per_current * record.motor_current
    # Backward, at rest and on the spot no radius is learned.
    keep = settled(rows, record.dt, curve_settings.settling) & (rows[:, 0] > 0) & np.isfinite(torques).all(axis=1)
    keep &= rows[:, 1] != 0
    curves.learn_drive(rows, torques[:, 0], torques[:, 1], record.dt, settled=keep)
    v, omega = rows[keep].T
    right = omega < 0
    outer, inner = (np.where(right, torques[keep, k], torques[keep, 1 - k]) for k in (0, 1))
    return np.stack([_same(v, omega), outer, inner], axis=-1)


def _same(v: FloatArray, omega: FloatArray) -> FloatArray:
    """Compute the radius at the speed of the curves [m] with the same demand as these commands."""
    curve_settings = load_torque_settings().curves
    return np.abs(v / omega) * (curve_settings.speed / np.abs(v)) ** curve_settings.speed_exponent


def _slip(records: Sequence[Record], curves: TorqueCurves) -> tuple[IdentifiedSlip | None, str]:
    """Identify the slip law from poses, or that of the yaw rate from the gyro, in turns above the least radius."""
    commands, twists, source = [], [], ""
    for record in records:
        step, every = (max(1, round(time / record.dt)) for time in (_BETWEEN_POSES, _EVERY))
        held = settled(record.command, record.dt, load_torque_settings().curves.settling)
        starts = np.arange(0, len(held) - step, every)
        # From a settled sample to another, with the same command between.
        whole = [k for k in starts.tolist() if held[k] and held[k : k + step + 1].all() and record.command[k, 0]]
        rows = record.command[whole]
        if record.pose is None and record.yaw_rate is None:
            return None, "no slip law: the log has neither poses nor a gyro"
        source = "slip of the yaw rate by the gyro; that ahead and to the side is not told and counts as none"
        body = np.stack([rows[:, 0], np.zeros(len(rows)), np.full(len(rows), np.nan)], axis=-1)
        if record.pose is not None:
            source = "slip law from poses"
            body = body_twists(record.pose[whole], record.pose[[k + step for k in whole]], step * record.dt)
        if record.yaw_rate is not None and whole:
            source += " and the gyro" if record.pose is not None else ""
            # A second of the gyro is better than two headings.
            body[:, 2] = [record.yaw_rate[k : k + step].mean() for k in whole]
        twists.append(body)
        commands.append(rows)
    rows, measured = np.concatenate(commands), np.concatenate(twists)
    with np.errstate(divide="ignore", invalid="ignore"):
        gentle = _same(rows[:, 0], rows[:, 1]) >= curves.least_radius()
    try:
        return identify_slip(rows, measured, used=gentle), source
    except ConfigError as error:
        return None, f"no slip law: {error}"


def _energies(record: Record, costs: TurnCosts, least: float) -> tuple[float, float]:
    """Compute measured and predicted energy in samples with a battery reading in turns above the `least` radius [J]."""
    v, omega = record.command.T
    with np.errstate(divide="ignore", invalid="ignore"):
        gentle = ~(_same(v, omega) < least)
    predicted = costs.power(record.command)
    if record.battery is None:
        return math.nan, float(predicted[gentle].sum() * record.dt)
    battery_power = record.battery.prod(axis=1)
    gentle &= np.isfinite(battery_power)
    return float(battery_power[gentle].sum() * record.dt), float(predicted[gentle].sum() * record.dt)
