"""Energy of a drive before it is driven, from the learned torque curves and the base's own wheel speeds."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc_extras.turn_costs.vehicle import DriveConstants, Vehicle

if TYPE_CHECKING:
    from diffdrive_mpc_extras.torque.torque_curves import TorqueCurves


class PredictedEnergy(NamedTuple):
    """Of n commands held one after the other."""

    torque: FloatArray
    """(n, 2) left, right [N m]"""
    wheel_speed: FloatArray
    """(n, 2) left, right [rad/s]"""
    power: FloatArray
    """(n,) that the battery gives [W]"""
    energy: float
    """[J]"""


def predict_energy(
    vehicle: Vehicle, constants: DriveConstants, curves: TorqueCurves, commands: ArrayLike, sample_time: float
) -> PredictedEnergy:
    """Energy of driving `commands` (n, 2) v [m/s], omega [rad/s], each for `sample_time` [s].

    Torques are those of steady turns: what speeding up takes and braking gives back is left out, as in P4, which is for
    gentle driving. Wheel speeds are those that the base makes of the commands.

    Raises
    ------
    models.checked_yaml.ConfigError
        If the commands are not rows of two finite numbers or the time is not positive.
    """
    rows = np.asarray(commands, dtype=float)
    if rows.ndim != 2 or rows.shape[1] != 2 or not np.isfinite(rows).all():
        raise ConfigError(f"commands of shape {rows.shape}: give (n, 2) finite numbers, v [m/s] and omega [rad/s]")
    if not (np.isfinite(sample_time) and sample_time > 0):
        raise ConfigError(f"sample time {sample_time} s: give a positive number")
    speeds = vehicle.rims(rows) / vehicle.wheel_radius
    torque = curves.torques(rows)
    power = constants.robot_power(torque, speeds)
    return PredictedEnergy(torque, speeds, power, float(power.sum() * sample_time))
