"""Torque curves of the outer and inner side over the turn radius, learned online, and turn costs from them."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc_extras.terrain.terrain_file import Terrain
from diffdrive_mpc_extras.terrain.turning import side_torques
from diffdrive_mpc_extras.torque.mran import MranNetwork, TorqueSettings, load_torque_settings
from diffdrive_mpc_extras.turn_costs import SlipCoefficients, TorqueTable, TurnCosts
from diffdrive_mpc_extras.turn_costs.turn_costs import LIMIT_SHARE, least_radius
from diffdrive_mpc_extras.turn_costs.vehicle import DriveConstants, Vehicle


class TorqueCurves:
    """Torque curves of the outer and inner side, one network each over the logarithm of the radius.

    The value of a curve is finite and within the limit. Beyond the learned radii the value at their end applies. Left
    and right turns have equal torques, and for backward driving the torques change their signs.

    Parameters
    ----------
    limit
        Torque limit of a side [N m].
    settings
        Settings of networks and curves; by default the shipped settings.

    Raises
    ------
    models.checked_yaml.ConfigError
        If the limit is not a positive number.
    """

    def __init__(self, limit: float, settings: TorqueSettings | None = None) -> None:
        if not (math.isfinite(limit) and limit > 0):
            raise ConfigError(f"torque limit {limit} N m: use a positive number")
        self.limit = float(limit)
        self._settings = settings or load_torque_settings()
        self._outer, self._inner = MranNetwork(self._settings.network), MranNetwork(self._settings.network)
        self._learned_inputs = (math.inf, -math.inf)

    @property
    def units(self) -> tuple[int, int]:
        """Numbers of hidden units of the networks of the outer and inner side."""
        return len(self._outer.units), len(self._inner.units)

    @property
    def learned_radii(self) -> tuple[float, float]:
        """Minimum and maximum learned radius [m], NaN before the first sample; values outside are held."""
        low, high = self._learned_inputs
        return (math.exp(low), math.exp(high)) if low <= high else (math.nan, math.nan)

    @classmethod
    def from_prior(cls, vehicle: Vehicle, terrain: Terrain, settings: TorqueSettings | None = None) -> TorqueCurves:
        """Build curves from computed torques of a prior terrain; P4, section 4.1.

        Raises ConfigError if the shear law of the terrain is unknown.
        """
        curves = cls(vehicle.torque_limit, settings)
        curve_settings = curves._settings.curves
        low = max(curve_settings.radii[0], 0.51 * (vehicle.command_track or vehicle.track))
        radii = np.geomspace(low, curve_settings.radii[1], curve_settings.prior_radii)
        torques = side_torques(vehicle, terrain, radii, curve_settings.speed)
        rows = np.stack([radii, torques.outer, torques.inner], axis=-1)
        for number in range(curve_settings.prior_passes):
            # Alternate the direction, so that neither end is always learned last.
            for radius, outer, inner in rows if number % 2 else rows[::-1]:
                curves.learn(radius, curve_settings.speed, outer, inner)
        curves.reset_covariance()
        return curves

    def reset_covariance(self) -> None:
        """Reset the covariance of both networks, because the terrain may have changed."""
        self._outer.reset_covariance()
        self._inner.reset_covariance()

    def learn(self, radius: float, speed: float, outer: float, inner: float) -> None:
        """Learn one sample of a steady turn; samples that are not finite are ignored.

        Parameters
        ----------
        radius
            Commanded turn radius of any sign [m]; infinity for a straight path.
        speed
            Commanded forward speed [m/s].
        outer, inner
            Torques of the sides [N m].
        """
        if not (speed > 0 and not math.isnan(radius) and math.isfinite(outer) and math.isfinite(inner)):
            return
        x = float(self._input(np.array(abs(radius)), np.array(speed)))
        self._learned_inputs = min(self._learned_inputs[0], x), max(self._learned_inputs[1], x)
        margin = self._settings.curves.margin
        self._outer.learn(x, float(np.clip(outer / self.limit, -margin, margin)))
        self._inner.learn(x, float(np.clip(inner / self.limit, -margin, margin)))

    def learn_drive(
        self,
        commands: ArrayLike,
        left: ArrayLike,
        right: ArrayLike,
        sample_time: float,
        settled: ArrayLike | None = None,
    ) -> int:
        """Learn the steady turns of a drive; return the number of learned rows.

        Parameters
        ----------
        commands
            (n, 2) v [m/s], omega [rad/s] in order of time.
        left, right
            (n,) torques of the sides between each row and the next [N m].
        sample_time
            Time between two rows [s].
        settled
            (n,) booleans that select steady turns; by default rows later than the settling time after a change of the
            command.
        """
        rows = np.asarray(commands, dtype=float)
        torques = np.stack([np.asarray(left, dtype=float), np.asarray(right, dtype=float)], axis=-1)
        if settled is None:
            changed = np.concatenate([[True], (np.abs(np.diff(rows, axis=0)) > 1e-9).any(axis=1)])
            rows_since = np.arange(len(rows)) - np.maximum.accumulate(np.where(changed, np.arange(len(rows)), 0))
            settled = (rows_since + 0.5) * sample_time > self._settings.curves.settling
        is_moving = rows[:, 0] != 0
        indices = np.flatnonzero(np.asarray(settled, dtype=bool) & is_moving)
        with np.errstate(divide="ignore", invalid="ignore"):
            radii = np.abs(rows[:, 0] / rows[:, 1])
        for k in indices.tolist():
            v, omega = rows[k]
            outer, inner = torques[k] if v * omega < 0 else torques[k, ::-1]
            sign = math.copysign(1.0, v)
            self.learn(float(radii[k]), abs(v), sign * outer, sign * inner)
        return len(indices)

    def outer(self, radius: ArrayLike, speed: ArrayLike | None = None) -> FloatArray:
        """Compute the torque (n,) of the outer side [N m] at radii (n,) [m] and speeds (n,) [m/s].

        The default speed is that of the settings.
        """
        return self._torque(self._outer, radius, speed)

    def inner(self, radius: ArrayLike, speed: ArrayLike | None = None) -> FloatArray:
        """Compute the torque (n,) of the inner side [N m], as `outer`."""
        return self._torque(self._inner, radius, speed)

    def torques(self, commands: ArrayLike) -> FloatArray:
        """Compute torques (n, 2) left, right [N m] of steady turns for commands (n, 2) v [m/s], omega [rad/s]."""
        v, omega = np.moveaxis(np.asarray(commands, dtype=float), -1, 0)
        with np.errstate(divide="ignore", invalid="ignore"):
            radius = np.abs(v / omega)
        is_moving = (v != 0) | (omega != 0)
        radius = np.where(is_moving, radius, np.inf)
        speed = np.maximum(np.abs(v), 1e-6)
        sign = np.where(v < 0, -1.0, 1.0)
        outer, inner = (sign * side(radius, speed) * is_moving for side in (self.outer, self.inner))
        is_left_outer = np.where(v == 0, omega < 0, v * omega < 0)
        return np.stack([np.where(is_left_outer, outer, inner), np.where(is_left_outer, inner, outer)], axis=-1)

    def least_radius(self, speed: float | None = None, share: float = LIMIT_SHARE) -> float:
        """Find the largest radius at which the outer torque exceeds `share` of its limit [m]; see `least_radius`."""
        low, high = self._settings.curves.radii
        return least_radius(lambda radii: self.outer(radii, speed), self.limit, (low, high), share)

    def _torque(self, network: MranNetwork, radius: ArrayLike, speed: ArrayLike | None) -> FloatArray:
        radii = np.abs(np.asarray(radius, dtype=float))
        speeds = np.full_like(radii, self._settings.curves.speed) if speed is None else np.asarray(speed, dtype=float)
        low, high = self._learned_inputs
        x = self._input(radii, speeds)
        output = network(np.clip(x, low, high) if low <= high else x)
        margin = self._settings.curves.margin
        return np.asarray(self.limit * np.clip(output, -margin, margin))

    def _input(self, radius: FloatArray, speed: FloatArray) -> FloatArray:
        """Compute the network input: logarithm of the equivalent radius at the reference speed."""
        curve_settings = self._settings.curves
        equivalent_radius = (
            radius * (curve_settings.speed / speed) ** curve_settings.speed_exponent
            if curve_settings.speed_exponent
            else radius
        )
        return np.asarray(np.log(np.clip(equivalent_radius, *curve_settings.radii)))


_TABLE_ROWS = 36


def costs_of_curves(
    curves: TorqueCurves,
    slip: ArrayLike,
    *,
    name: str,
    vehicle: Vehicle,
    drive: DriveConstants,
    provenance: str,
    radii: tuple[float, float] | None = None,
) -> TurnCosts:
    """Build turn costs from learned curves and a slip law.

    Parameters
    ----------
    curves
        Learned curves.
    slip
        (3, 3) or (9,) coefficients of the slip law.
    name, vehicle, drive, provenance
        Other fields of the turn costs.
    radii
        Minimum and maximum radius of the table, at the reference speed [m]; by default all learned radii, including
        those of the prior.

    Raises
    ------
    models.checked_yaml.ConfigError
        If the curves have learned fewer than two radii, or a value is invalid.
    """
    low, high = radii or curves.learned_radii
    if not high > low:
        raise ConfigError(f"turn costs '{name}': the torque curves need at least two radii; learn a drive first")
    settings = load_torque_settings().curves
    table_radii = np.geomspace(low, high, _TABLE_ROWS)
    table = TorqueTable(
        radius=tuple(table_radii.tolist()),
        outer=tuple(curves.outer(table_radii).tolist()),
        inner=tuple(curves.inner(table_radii).tolist()),
        speed=settings.speed,
        speed_exponent=settings.speed_exponent,
    )
    return TurnCosts(
        name=name,
        vehicle=vehicle,
        drive=drive,
        slip=SlipCoefficients.from_rows(slip),
        curve=table,
        provenance=provenance,
    )


class PredictedEnergy(NamedTuple):
    """Predicted power and energy of a sequence of n commands."""

    torque: FloatArray
    """Torques (n, 2) left, right [N m]"""
    wheel_speed: FloatArray
    """Wheel speeds (n, 2) left, right [rad/s]"""
    power: FloatArray
    """Battery power (n,) [W]"""
    energy: float
    """Battery energy [J]"""


def predict_energy(
    vehicle: Vehicle, constants: DriveConstants, curves: TorqueCurves, commands: ArrayLike, sample_time: float
) -> PredictedEnergy:
    """Predict the energy of `commands` (n, 2) v [m/s], omega [rad/s], each for `sample_time` [s].

    Torques are those of steady turns. As in P4, the energy of acceleration and braking is neglected, which is valid for
    gentle driving. Wheel speeds follow from the commands by the kinematics of the base.

    Raises
    ------
    models.checked_yaml.ConfigError
        If the commands are not rows of two finite numbers or the time is not positive.
    """
    rows = np.asarray(commands, dtype=float)
    if rows.ndim != 2 or rows.shape[1] != 2 or not np.isfinite(rows).all():
        raise ConfigError(f"commands of shape {rows.shape}: use (n, 2) finite numbers, v [m/s] and omega [rad/s]")
    if not (np.isfinite(sample_time) and sample_time > 0):
        raise ConfigError(f"sample time {sample_time} s: use a positive number")
    speeds = vehicle.rim_speeds(rows) / vehicle.wheel_radius
    torque = curves.torques(rows)
    power = constants.robot_power(torque, speeds)
    return PredictedEnergy(torque, speeds, power, float(power.sum() * sample_time))
