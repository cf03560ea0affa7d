"""Inputs of the search: commands with the motion and the cost of each, and closed-form paths of three pieces.

The paths hold for any constant twists, including side slip. A body under a constant twist turns about a centre c that
is fixed in the body frame. With headings a and b at the joints, the vector D from the first to the last centre is
R(a) (L d + c3 - c1) for arc-straight-arc, with the drift direction d of straight motion, and
R(a) (c2 - c1) + R(b) (c3 - c2) for three arcs, which is the geometry of a two-link arm. Without slip and with a single
radius these are the words of Dubins, American Journal of Mathematics 79(3), 1957.
"""

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
_SPOT_TORQUE_RATIO = 0.9
# Minimum yaw rate of a turn on the spot [rad/s].
_MIN_SPOT_RATE = 0.02
_MULTIPLIERS = 12


class Inputs(NamedTuple):
    """Set of m constant inputs."""

    commands: FloatArray
    """(m, 2) commanded v [m/s], omega [rad/s]."""
    twists: FloatArray
    """(m, 3) twists of the body by the slip law."""
    rates: FloatArray
    """(m,) objective per second."""
    straight: Mask
    """(m,) True if the body moves straight."""

    @property
    def centres(self) -> FloatArray:
        """(m, 2) centre of rotation in the body frame [m]; not finite for straight motion."""
        v, lateral, omega = self.twists.T
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.stack([-lateral / omega, v / omega], axis=-1)

    @property
    def speeds(self) -> FloatArray:
        """(m,) speed of the body over the surface [m/s]."""
        return np.hypot(self.twists[:, 0], self.twists[:, 1])

    def displacements(self, index: Index, times: FloatArray) -> FloatArray:
        """Compute displacements (..., 3) in the frame of the start under inputs `index` (...) for `times` (...) [s]."""
        v, lateral, omega = np.moveaxis(self.twists[index], -1, 0)
        half = 0.5 * omega * times
        reach = times * np.sinc(half / np.pi)
        c, s = np.cos(half), np.sin(half)
        return np.stack([reach * (v * c - lateral * s), reach * (v * s + lateral * c), omega * times], axis=-1)

    def select(self, rows: Index) -> Inputs:
        """Return some of the inputs."""
        return Inputs(self.commands[rows], self.twists[rows], self.rates[rows], self.straight[rows])

    def multipliers(self) -> tuple[FloatArray, FloatArray]:
        """Compute multipliers (k,) of distance and turning, for lower bounds of the cost.

        For each pair, price_s s + price_b b is a lower bound of the cost of any sequence of inputs with distance s and
        turning b. The pairs are dual feasible for the linear program over mixtures of inputs.
        """
        speeds, turning = self.speeds, np.abs(self.twists[:, 2])
        moves = speeds > 1e-9
        max_price = float((self.rates[moves] / speeds[moves]).min())
        metre = max_price * np.linspace(0.0, 1.0, _MULTIPLIERS)
        turns = turning > 1e-9
        remainder = self.rates[turns] - metre[:, None] * speeds[turns]
        radian = (remainder / turning[turns]).min(axis=1) if turns.any() else np.zeros_like(metre)
        return metre, np.maximum(radian, 0.0)


def sharpest_radius(costs: TurnCosts, speed: float, settings: PlanSettings) -> float:
    """Compute the minimum commanded radius of the plan [m]: the limit of the motors, but at least half the track.

    At half the track the inner wheels are at rest. Sharper turns cost the same without progress.
    """
    half = 0.5 * (costs.vehicle.command_track or costs.vehicle.track)
    return max(half, costs.least_radius(speed) * (1 + settings.polish.radius_margin))


def straight_command(costs: TurnCosts, v: float) -> FloatArray:
    """Return the command (2,) with speed `v` [m/s] for which the body does not turn."""
    (_, _, _), _, (a31, a32, a33) = costs.slip.rows
    return np.array([v, -a31 * v / (1 + a32 + a33 * v)])


def spot_rate(costs: TurnCosts, max_rate: float) -> float:
    """Compute the maximum commanded yaw rate on the spot within motor limits [rad/s]; 0 if it is impossible."""
    rates = np.geomspace(_MIN_SPOT_RATE, max_rate, 60)
    torque = np.abs(costs.torques(np.stack([np.zeros_like(rates), rates], -1))).max(axis=1)
    feasible = rates[torque < _SPOT_TORQUE_RATIO * costs.vehicle.torque_limit]
    return float(feasible.max()) if feasible.size else 0.0


def make_inputs(
    costs: TurnCosts, minimise: Objective, speed: float, settings: PlanSettings, *, reverse: bool, spot: bool
) -> Inputs:
    """Build the inputs: straight motion, sampled arcs, the sharpest arc, and optionally reverse and spot turns."""
    search_settings, sharp = settings.search, sharpest_radius(costs, speed, settings)
    drawn = Halton(1, scramble=False).random(search_settings.yaw_rates + 1)[1:, 0]
    curvatures = np.append(drawn**search_settings.concentration, 1.0) / sharp
    rows: list[FloatArray] = []
    for sense in (1.0, -1.0) if reverse else (1.0,):
        rows.append(straight_command(costs, sense * speed))
        for curvature in curvatures:
            # The speed of sharp arcs is limited by the yaw rate.
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
    """Compute the objective per second (n,): W, s/s or m/s."""
    if minimise == "energy":
        return costs.power(commands)
    return np.ones(len(commands)) if minimise == "time" else np.hypot(twists[:, 0], twists[:, 1])


_FULL_TURN = 2 * np.pi
_TOLERANCE = 1e-9


class Words(NamedTuple):
    """Set of k paths of three pieces."""

    start: Index
    """(k,) index of the start pose."""
    inputs: Index
    """(k, 3) index of the input of each piece."""
    times: FloatArray
    """(k, 3) duration of each piece [s]."""
    costs: FloatArray
    """(k,) objective of each path."""


def arc_straight_arc(inputs: Inputs, poses: FloatArray, goal: FloatArray) -> Words:
    """Build all paths arc, straight line, arc from poses (n, 3) to one goal (3,)."""
    arcs, lines = np.flatnonzero(~inputs.straight), np.flatnonzero(inputs.straight)
    first, line, last = (indices.ravel() for indices in np.meshgrid(arcs, lines, arcs, indexing="ij"))
    centres = inputs.centres
    drift, speed = inputs.twists[line, :2], inputs.speeds[line]
    along, gap = drift / speed[:, None], centres[last] - centres[first]
    between = _transform(goal, centres[last])[None] - _transform(poses[:, None], centres[first])
    ahead = (along * gap).sum(-1)
    square = ahead**2 + (between**2).sum(-1) - (gap**2).sum(-1)
    length = np.sqrt(np.maximum(square, 0.0)) - ahead
    reach = length[..., None] * along + gap
    heading = np.arctan2(between[..., 1], between[..., 0]) - np.arctan2(reach[..., 1], reach[..., 0])
    times = np.stack(
        [
            _turn_time(inputs, first, heading - poses[:, None, 2]),
            length / speed,
            _turn_time(inputs, last, goal[2] - heading),
        ],
        axis=-1,
    )
    return _feasible_words(inputs, np.stack([first, line, last], -1), times, (square >= 0) & (length >= -_TOLERANCE))


def arc_arc_arc(inputs: Inputs, poses: FloatArray, goal: FloatArray) -> Words:
    """Build all paths of three different consecutive arcs from poses (n, 3) to one goal (3,)."""
    arcs = np.flatnonzero(~inputs.straight & (inputs.speeds > _TOLERANCE))
    first, middle, last = (indices.ravel() for indices in np.meshgrid(arcs, arcs, arcs, indexing="ij"))
    differ = (first != middle) & (middle != last)
    first, middle, last = first[differ], middle[differ], last[differ]
    centres = inputs.centres
    near, far = centres[middle] - centres[first], centres[last] - centres[middle]
    between = _transform(goal, centres[last])[None] - _transform(poses[:, None], centres[first])
    upper, lower = np.hypot(*near.T), np.hypot(*far.T)
    with np.errstate(divide="ignore", invalid="ignore"):
        bent = ((between**2).sum(-1) - upper**2 - lower**2) / (2 * upper * lower)
    fits, paths = np.abs(bent) <= 1, []
    for side in (1.0, -1.0):
        elbow = side * np.arccos(np.clip(bent, -1, 1))
        shoulder = np.arctan2(between[..., 1], between[..., 0]) - np.arctan2(
            lower * np.sin(elbow), upper + lower * np.cos(elbow)
        )
        a = shoulder - np.arctan2(near[:, 1], near[:, 0])
        b = shoulder + elbow - np.arctan2(far[:, 1], far[:, 0])
        times = np.stack(
            [
                _turn_time(inputs, first, a - poses[:, None, 2]),
                _turn_time(inputs, middle, b - a),
                _turn_time(inputs, last, goal[2] - b),
            ],
            axis=-1,
        )
        paths.append(_feasible_words(inputs, np.stack([first, middle, last], -1), times, fits))
    return Words(*(np.concatenate(parts) for parts in zip(*paths, strict=True)))


def arc_straight(inputs: Inputs, poses: FloatArray, point: FloatArray) -> Words:
    """Build all paths arc, straight line from poses (n, 3) to a point (2,); the third piece has zero duration."""
    arcs, lines = np.flatnonzero(~inputs.straight), np.flatnonzero(inputs.straight)
    first, line = (indices.ravel() for indices in np.meshgrid(arcs, lines, indexing="ij"))
    centre = inputs.centres[first]
    speed = inputs.speeds[line]
    along = inputs.twists[line, :2] / speed[:, None]
    between = point - _transform(poses[:, None], centre)
    ahead = (along * centre).sum(-1)
    square = ahead**2 + (between**2).sum(-1) - (centre**2).sum(-1)
    length = ahead + np.sqrt(np.maximum(square, 0.0))
    reach = length[..., None] * along - centre
    heading = np.arctan2(between[..., 1], between[..., 0]) - np.arctan2(reach[..., 1], reach[..., 0])
    turned = _turn_time(inputs, first, heading - poses[:, None, 2])
    times = np.stack([turned, length / speed, np.zeros_like(turned)], axis=-1)
    return _feasible_words(inputs, np.stack([first, line, line], -1), times, (square >= 0) & (length >= -_TOLERANCE))


def move_poses(poses: FloatArray, displacements: FloatArray) -> FloatArray:
    """Move poses (..., 3) by displacements (..., 3) in their frames; headings are not wrapped."""
    return np.concatenate([_transform(poses, displacements[..., :2]), poses[..., 2:] + displacements[..., 2:]], axis=-1)


def _transform(poses: FloatArray, points: FloatArray) -> FloatArray:
    c, s = np.cos(poses[..., 2]), np.sin(poses[..., 2])
    x, y = points[..., 0], points[..., 1]
    return np.stack([poses[..., 0] + c * x - s * y, poses[..., 1] + s * x + c * y], axis=-1)


def _turn_time(inputs: Inputs, index: Index, angle: FloatArray) -> FloatArray:
    """Compute the time in which an input turns the body by `angle` in its direction of rotation [s]."""
    omega = inputs.twists[index, 2]
    turn = np.mod(np.sign(omega) * angle, _FULL_TURN)
    return np.asarray(np.where(turn > _FULL_TURN - 1e-7, 0.0, turn) / np.abs(omega))


def _feasible_words(inputs: Inputs, index: Index, times: FloatArray, fits: Mask) -> Words:
    start, word = np.nonzero(fits)
    durations = np.maximum(times[start, word], 0.0)
    selected = index[word]
    return Words(start, selected, durations, (durations * inputs.rates[selected]).sum(axis=-1))
