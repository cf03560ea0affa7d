"""The inputs that the search tries: yaw rates at a speed, what the body does under each, and what that costs."""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats.qmc import Halton

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc_extras.planner.settings import PlanSettings
from diffdrive_mpc_extras.turn_costs import TurnCosts

Objective = Literal["energy", "time", "distance"]
Index = NDArray[np.intp]
Mask = NDArray[np.bool_]
OBJECTIVES: tuple[Objective, ...] = ("energy", "time", "distance")
_SPOT_SHARE = 0.9
# Slower ones are no way to turn on the spot [rad/s].
_SLOWEST_SPOT = 0.02
_MULTIPLIERS = 12


class Inputs(NamedTuple):
    """m inputs, each held for some time."""

    commands: FloatArray
    """(m, 2) v [m/s], omega [rad/s]"""
    twists: FloatArray
    """(m, 3) of the body by the slip law"""
    rates: FloatArray
    """(m,) of the objective, per second"""
    straight: Mask
    """(m,) of bool: the body goes straight on"""

    @property
    def centres(self) -> FloatArray:
        """(m, 2) centre about which the body turns, seen from it [m]; not finite straight on."""
        v, lateral, omega = self.twists.T
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.stack([-lateral / omega, v / omega], axis=-1)

    @property
    def speeds(self) -> FloatArray:
        """(m,) of the body over the floor [m/s]."""
        return np.hypot(self.twists[:, 0], self.twists[:, 1])

    def moved(self, index: Index, times: FloatArray) -> FloatArray:
        """(..., 3) displacement in the frame of the start under inputs `index` (...) for `times` (...) [s]."""
        v, lateral, omega = np.moveaxis(self.twists[index], -1, 0)
        half = 0.5 * omega * times
        reach = times * np.sinc(half / np.pi)
        c, s = np.cos(half), np.sin(half)
        return np.stack([reach * (v * c - lateral * s), reach * (v * s + lateral * c), omega * times], axis=-1)

    def chosen(self, rows: Index) -> Inputs:
        """Some of them."""
        return Inputs(self.commands[rows], self.twists[rows], self.rates[rows], self.straight[rows])

    def multipliers(self) -> tuple[FloatArray, FloatArray]:
        """Prices (k,) of a metre and of a radian such that no input is cheaper than what it gains.

        For distance s and turning b, price_s s + price_b b is then a lower bound of what any sequence of inputs costs:
        the dual of the linear program that mixes inputs.
        """
        speeds, turning = self.speeds, np.abs(self.twists[:, 2])
        moves = speeds > 1e-9
        dearest = float((self.rates[moves] / speeds[moves]).min())
        metre = dearest * np.linspace(0.0, 1.0, _MULTIPLIERS)
        turns = turning > 1e-9
        left = self.rates[turns] - metre[:, None] * speeds[turns]
        radian = (left / turning[turns]).min(axis=1) if turns.any() else np.zeros_like(metre)
        return metre, np.maximum(radian, 0.0)


def sharpest_radius(costs: TurnCosts, speed: float, settings: PlanSettings) -> float:
    """Least commanded radius of the plan [m]: that of the motors, and no sharper than half the track.

    At half the track the inner wheels stand; sharper turns cost as much and do not come on.
    """
    half = 0.5 * (costs.vehicle.command_track or costs.vehicle.track)
    return max(half, costs.least_radius(speed) * (1 + settings.polish.radius_margin))


def straight_command(costs: TurnCosts, v: float) -> FloatArray:
    """(2,) command of this v [m/s] under which the body does not turn."""
    (_, _, _), _, (a31, a32, a33) = costs.slip.rows
    return np.array([v, -a31 * v / (1 + a32 + a33 * v)])


def spot_rate(costs: TurnCosts, most: float) -> float:
    """Fastest commanded yaw rate on the spot that the motors can [rad/s]; 0 where they cannot."""
    rates = np.geomspace(_SLOWEST_SPOT, most, 60)
    torque = np.abs(costs.torques(np.stack([np.zeros_like(rates), rates], -1))).max(axis=1)
    can = rates[torque < _SPOT_SHARE * costs.vehicle.torque_limit]
    return float(can.max()) if can.size else 0.0


def make_inputs(
    costs: TurnCosts, minimise: Objective, speed: float, settings: PlanSettings, *, reverse: bool, spot: bool
) -> Inputs:
    """Straight on, sampled yaw rates, the sharpest arc, and turning on the spot; backward, too, if asked."""
    asked, sharp = settings.search, sharpest_radius(costs, speed, settings)
    drawn = Halton(1, scramble=False).random(asked.yaw_rates + 1)[1:, 0]
    curvatures = np.append(drawn**asked.concentration, 1.0) / sharp
    rows: list[FloatArray] = []
    for sense in (1.0, -1.0) if reverse else (1.0,):
        rows.append(straight_command(costs, sense * speed))
        for curvature in curvatures:
            # Sharper arcs than the yaw rate allows are driven slower.
            v = min(speed, settings.motion.yaw_rate / curvature)
            rows += [np.array([sense * v, side * v * curvature]) for side in (1.0, -1.0)]
    rate = spot_rate(costs, settings.motion.yaw_rate) if spot else 0.0
    if rate:
        rows += [np.array([0.0, side * rate]) for side in (1.0, -1.0)]
    commands = np.array(rows)
    twists = costs.twist(commands)
    straight = np.abs(twists[:, 2]) < 1e-9
    twists[straight, 2] = 0.0
    return Inputs(commands, twists, rates_of(costs, minimise, commands, twists), straight)


def rates_of(costs: TurnCosts, minimise: Objective, commands: FloatArray, twists: FloatArray) -> FloatArray:
    """(n,) of the objective per second: W, s/s or m/s."""
    if minimise == "energy":
        return costs.power(commands)
    return np.ones(len(commands)) if minimise == "time" else np.hypot(twists[:, 0], twists[:, 1])
