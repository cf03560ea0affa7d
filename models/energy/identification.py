"""Constants of the drive from a log with the battery's voltage and current and the currents of the motors."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.energy.drive_constants import DriveConstants
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.record import Record

_LEAST_ROWS = 50
# Two columns more alike than this cannot be told apart.
_ALIKE = 1e6


class IdentifiedConstants(NamedTuple):
    """What was found."""

    constants: DriveConstants
    """With torque constant, resistance and idle power of the log; regeneration and efficiency are those given"""
    deviation: dict[str, float]
    """Standard deviation of each value found"""
    rms: float
    """What remains of the battery's power [W]"""
    rows: int
    """How many samples told it"""


def identify_constants(records: Sequence[Record], prior: DriveConstants) -> IdentifiedConstants:
    """Torque constant, resistance and idle power, by least squares on the power of the battery.

    The battery gives V I = sum over the sides of k (wheel speed times current) + (R_e / n) current^2, + idle power, for
    currents of sides of n motors: k = K_T g eta turns current into torque by equations 25 and 26, so the three are
    linear in what is logged. Only samples whose current drives are used where the prior has no regeneration.

    Parameters
    ----------
    records
        With `battery`, `motor_current` and `wheels`.
    prior
        Its gears, efficiencies and number of motors are kept.

    Raises
    ------
    models.checked_yaml.ConfigError
        If the log lacks a column, has too few samples, or its drive does not tell the three apart.
    """
    power, current, speed = _columns(records)
    mechanical, squares = speed * current, current**2
    if not prior.regeneration:
        # A side that brakes takes nothing from the battery: what it does is not in the battery's power.
        driving = (mechanical >= 0).all(axis=1)
        power, mechanical, squares = power[driving], mechanical[driving], squares[driving]
    if len(power) < _LEAST_ROWS:
        raise ConfigError(
            f"{len(power)} samples with battery, motors and wheels: give a log with {_LEAST_ROWS} or more"
        )
    rows = np.stack([mechanical.sum(axis=1), squares.sum(axis=1), np.ones(len(power))], axis=-1)
    scale = np.linalg.norm(rows, axis=0)
    if (scale == 0).any() or np.linalg.cond(rows / scale) > _ALIKE:
        raise ConfigError(
            "the drive does not tell torque constant, resistance and idle power apart: let the robot stand, drive "
            "slowly under load (turns) and fast under little (straight on)"
        )
    values, *_ = np.linalg.lstsq(rows / scale, power, rcond=None)
    values = values / scale
    rest = power - rows @ values
    rms = float(np.sqrt(np.mean(rest**2)))
    spread = rms * np.sqrt(np.diag(np.linalg.inv((rows / scale).T @ (rows / scale)))) / scale
    slope, heating, idle = (values * [prior.driver_efficiency, prior.driver_efficiency, 1.0]).tolist()
    names = ("torque_constant", "resistance", "idle_power")
    geared = prior.gear_ratio * prior.gear_efficiency
    found = dict(zip(names, (slope / geared, heating * prior.motors_per_side, idle), strict=True))
    if not (found["torque_constant"] > 0 and found["resistance"] > 0):
        raise ConfigError(
            f"torque constant {found['torque_constant']:.3g} N m/A and resistance {found['resistance']:.3g} ohm follow "
            "from the log: both have to be positive; check signs and units of the currents in the mapping"
        )
    found["idle_power"] = max(0.0, found["idle_power"])
    sizes = np.array([prior.driver_efficiency / geared, prior.driver_efficiency * prior.motors_per_side, 1.0])
    deviation = dict(zip(names, (spread * sizes).tolist(), strict=True))
    words = (
        f"identified from {len(power)} samples of {', '.join(one.name for one in records)}; before: {prior.provenance}"
    )
    constants = prior.model_copy(update={**found, "provenance": words})
    return IdentifiedConstants(constants, deviation, rms, len(power))


def logged_energy(records: Sequence[Record]) -> float:
    """What the battery gave over the records [J]; raises ConfigError where they do not tell voltage and current."""
    total = 0.0
    for record in records:
        if record.battery is None:
            raise ConfigError(f"record '{record.name}': no battery; name 'battery.voltage' and 'battery.current'")
        total += float(np.nansum(record.battery.prod(axis=1)) * record.dt)
    return total


def _columns(records: Sequence[Record]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Power of the battery (n,) [W], currents (n, 2) [A] and wheel speeds (n, 2) [rad/s] of the sides."""
    parts = []
    for record in records:
        if record.battery is None or record.motor_current is None or record.wheels is None:
            absent = [
                key
                for key, value in (
                    ("battery", record.battery),
                    ("motors", record.motor_current),
                    ("encoders", record.wheels),
                )
                if value is None
            ]
            raise ConfigError(
                f"record '{record.name}': no {' and no '.join(absent)}; name their columns in the mapping"
            )
        rows = np.column_stack([record.battery.prod(axis=1), record.motor_current, record.wheels])
        parts.append(rows[np.isfinite(rows).all(axis=1)])
    whole = np.concatenate(parts) if parts else np.empty((0, 5))
    return whole[:, 0], whole[:, 1:3], whole[:, 3:]
