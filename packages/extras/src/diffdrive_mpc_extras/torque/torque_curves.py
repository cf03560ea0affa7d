"""Torque of the outer and the inner side against turn radius, a network each, learned while driving."""

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
    """Two networks over the logarithm of the radius, whose outputs are torques over the limit of a side.

    The value of a curve is finite and within the limit; beyond the learned radii it keeps the value at their end. A
    turn is the same to the left and to the right, and backward the torques change their signs.

    Parameters
    ----------
    limit
        Largest torque of a side [N m].
    settings
        By default the shipped ones.

    Raises
    ------
    models.checked_yaml.ConfigError
        If the limit is not a positive number.
    """

    def __init__(self, limit: float, settings: TorqueSettings | None = None) -> None:
        if not (math.isfinite(limit) and limit > 0):
            raise ConfigError(f"torque limit {limit} N m: give a positive number")
        self.limit = float(limit)
        self._settings = settings or load_torque_settings()
        self._outer, self._inner = MranNetwork(self._settings.network), MranNetwork(self._settings.network)
        self._shown = (math.inf, -math.inf)

    @property
    def units(self) -> tuple[int, int]:
        """Return the numbers of hidden units of the networks of the outer and the inner side."""
        return len(self._outer.units), len(self._inner.units)

    @property
    def shown(self) -> tuple[float, float]:
        """Least and greatest radius that was shown [m]; beyond it the value is held."""
        low, high = self._shown
        return (math.exp(low), math.exp(high)) if low <= high else (math.nan, math.nan)

    @classmethod
    def from_prior(cls, vehicle: Vehicle, terrain: Terrain, settings: TorqueSettings | None = None) -> TorqueCurves:
        """Build curves that contain the triplets (radius, outer, inner) of a former terrain; P4, section 4.1.

        Raises ConfigError if the shear law of the terrain is not known.
        """
        curves = cls(vehicle.torque_limit, settings)
        curve_settings = curves._settings.curves
        low = max(curve_settings.radii[0], 0.51 * (vehicle.command_track or vehicle.track))
        radii = np.geomspace(low, curve_settings.radii[1], curve_settings.prior_radii)
        torques = side_torques(vehicle, terrain, radii, curve_settings.speed)
        rows = np.stack([radii, torques.outer, torques.inner], axis=-1)
        for turn in range(curve_settings.prior_passes):
            # To and fro, as a drive does, so that no end is the one shown last.
            for radius, outer, inner in rows if turn % 2 else rows[::-1]:
                curves.learn(radius, curve_settings.speed, outer, inner)
        curves.doubt()
        return curves

    def doubt(self) -> None:
        """Increase the uncertainty of learned curves: another terrain may have started."""
        self._outer.restart_doubt()
        self._inner.restart_doubt()

    def learn(self, radius: float, speed: float, outer: float, inner: float) -> None:
        """Take in one sample of a steady turn; values that are not finite are left out.

        Parameters
        ----------
        radius
            Commanded turn radius [m]; its sign does not matter, infinity is straight on.
        speed
            Commanded speed [m/s], forward.
        outer, inner
            Torques of the sides [N m].
        """
        if not (speed > 0 and not math.isnan(radius) and math.isfinite(outer) and math.isfinite(inner)):
            return
        x = float(self._input(np.array(abs(radius)), np.array(speed)))
        self._shown = min(self._shown[0], x), max(self._shown[1], x)
        bound = self._settings.curves.margin
        self._outer.learn(x, float(np.clip(outer / self.limit, -bound, bound)))
        self._inner.learn(x, float(np.clip(inner / self.limit, -bound, bound)))

    def learn_drive(
        self,
        commands: ArrayLike,
        left: ArrayLike,
        right: ArrayLike,
        sample_time: float,
        settled: ArrayLike | None = None,
    ) -> int:
        """Take in a drive in order of time, but for what follows a change of the command; returns how much was used.

        Parameters
        ----------
        commands
            (n, 2) v [m/s], omega [rad/s].
        left, right
            (n,) torques of the sides [N m] from this row to the next.
        sample_time
            Time between two rows [s].
        settled
            (n,) of bool: the rows of steady turns; by default those in which the command has not changed for the
            settling time.
        """
        rows = np.asarray(commands, dtype=float)
        torques = np.stack([np.asarray(left, dtype=float), np.asarray(right, dtype=float)], axis=-1)
        if settled is None:
            changed = np.concatenate([[True], (np.abs(np.diff(rows, axis=0)) > 1e-9).any(axis=1)])
            since = np.arange(len(rows)) - np.maximum.accumulate(np.where(changed, np.arange(len(rows)), 0))
            settled = (since + 0.5) * sample_time > self._settings.curves.settling
        turning = rows[:, 0] != 0
        used = np.flatnonzero(np.asarray(settled, dtype=bool) & turning)
        with np.errstate(divide="ignore", invalid="ignore"):
            radii = np.abs(rows[:, 0] / rows[:, 1])
        for k in used.tolist():
            v, omega = rows[k]
            outer, inner = torques[k] if v * omega < 0 else torques[k, ::-1]
            sign = math.copysign(1.0, v)
            self.learn(float(radii[k]), abs(v), sign * outer, sign * inner)
        return len(used)

    def outer(self, radius: ArrayLike, speed: ArrayLike | None = None) -> FloatArray:
        """Compute the outer side's torque [N m] at radii (n,) [m] and speeds, by default the configured one."""
        return self._say(self._outer, radius, speed)

    def inner(self, radius: ArrayLike, speed: ArrayLike | None = None) -> FloatArray:
        """Compute the torque of the inner side [N m], as `outer`."""
        return self._say(self._inner, radius, speed)

    def torques(self, commands: ArrayLike) -> FloatArray:
        """Compute torques left, right (n, 2) [N m] for held commands (n, 2) v [m/s], omega [rad/s]; zero at rest."""
        v, omega = np.moveaxis(np.asarray(commands, dtype=float), -1, 0)
        with np.errstate(divide="ignore", invalid="ignore"):
            radius = np.abs(v / omega)
        moving = (v != 0) | (omega != 0)
        radius = np.where(moving, radius, np.inf)
        speed = np.maximum(np.abs(v), 1e-6)
        sign = np.where(v < 0, -1.0, 1.0)
        outer, inner = (sign * side(radius, speed) * moving for side in (self.outer, self.inner))
        left_outer = np.where(v == 0, omega < 0, v * omega < 0)
        return np.stack([np.where(left_outer, outer, inner), np.where(left_outer, inner, outer)], axis=-1)

    def least_radius(self, speed: float | None = None, share: float = LIMIT_SHARE) -> float:
        """Find the largest radius at which the outer side needs more than `share` of its limit [m]; 0 without one."""
        low, high = self._settings.curves.radii
        return least_radius(lambda radii: self.outer(radii, speed), self.limit, (low, high), share)

    def _say(self, network: MranNetwork, radius: ArrayLike, speed: ArrayLike | None) -> FloatArray:
        radii = np.abs(np.asarray(radius, dtype=float))
        speeds = np.full_like(radii, self._settings.curves.speed) if speed is None else np.asarray(speed, dtype=float)
        low, high = self._shown
        x = self._input(radii, speeds)
        output = network(np.clip(x, low, high) if low <= high else x)
        bound = self._settings.curves.margin
        return np.asarray(self.limit * np.clip(output, -bound, bound))

    def _input(self, radius: FloatArray, speed: FloatArray) -> FloatArray:
        curve_settings = self._settings.curves
        same = (
            radius * (curve_settings.speed / speed) ** curve_settings.speed_exponent
            if curve_settings.speed_exponent
            else radius
        )
        return np.asarray(np.log(np.clip(same, *curve_settings.radii)))


# Turn costs from learned torque curves.


_ROWS = 36


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
    """Build the file's content from learned curves and slip (3, 3) or nine coefficients.

    Parameters
    ----------
    curves, slip
        Learned curves and slip.
    name, vehicle, drive, provenance
        Other content of the file.
    radii
        Smallest and largest radius of the tabled curves, at their speed [m]: those of the drive; by default all that
        were shown to the curves, their prior's too.

    Raises
    ------
    models.checked_yaml.ConfigError
        If nothing was shown to the curves or a value cannot be used.
    """
    low, high = radii or curves.shown
    if not high > low:
        raise ConfigError(f"turn costs '{name}': the torque curves were shown no two radii; learn a drive first")
    settings = load_torque_settings().curves
    table_radii = np.geomspace(low, high, _ROWS)
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
    """Predicted energy of n commands held in sequence."""

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
    """Predict the energy of driving `commands` (n, 2) v [m/s], omega [rad/s], each for `sample_time` [s].

    Torques are those of steady turns: the energy of accelerating and braking is neglected, as in P4, which is for
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
    speeds = vehicle.rim_speeds(rows) / vehicle.wheel_radius
    torque = curves.torques(rows)
    power = constants.robot_power(torque, speeds)
    return PredictedEnergy(torque, speeds, power, float(power.sum() * sample_time))
