"""Local optimisation of the shape by direct multiple shooting with CasADi and IPOPT."""

from __future__ import annotations

from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.slip_laws import polynomial_terms
from diffdrive_mpc_extras.planner.clearance import Clearance
from diffdrive_mpc_extras.planner.inputs import Objective
from diffdrive_mpc_extras.planner.schedule import Schedule
from diffdrive_mpc_extras.planner.settings import PlanSettings
from diffdrive_mpc_extras.turn_costs import TurnCosts

# Number of obstacles that are checked for each disc of the robot at each node, and their largest distance [m].
_NEAREST, _WITHIN = 2, 2.0
# Minimum duration of a phase [s], and maximum ratio to its duration in the search.
_MIN_PHASE, _MAX_RATIO = 0.02, 1.5
_SOLVED = ("Solve_Succeeded", "Solved_To_Acceptable_Level")


class Polished(NamedTuple):
    """Result of IPOPT."""

    durations: FloatArray
    """(phases,) durations [s]."""
    yaw_rates: FloatArray
    """(n + 1,) commanded yaw rates at the nodes [rad/s]."""
    status: str
    """Status text of IPOPT."""
    solved: bool


def polish(
    costs: TurnCosts,
    minimise: Objective,
    schedule: Schedule,
    start: FloatArray,
    goal: FloatArray,
    via: FloatArray,
    settings: PlanSettings,
    clearance: Clearance | None,
) -> Polished:
    """Optimise durations and yaw rates, starting from those of the search.

    Parameters
    ----------
    costs
        Slip law and power.
    minimise
        Quantity to minimise.
    schedule
        Phases of the search.
    start, goal
        (3,) poses; the heading of the goal includes the full turns of the search.
    via
        (m, 2) via points at the ends of legs.
    settings
        Accelerations, and settings of the solver.
    clearance
        Distances to the obstacles; None for no obstacles.
    """
    polish_settings, motion, count = settings.polish, settings.motion, len(schedule.phase)
    x, w, d = ca.MX.sym("x", 3, count + 1), ca.MX.sym("w", 1, count + 1), ca.MX.sym("d", len(schedule.durations))
    share = np.zeros((len(schedule.durations), count))
    share[schedule.phase, np.arange(count)] = 1.0 / schedule.counts[schedule.phase]
    steps = ca.mtimes(d.T, ca.DM(share))
    v = ca.DM(schedule.speeds).T
    predicted = _interval(costs).map(count)(x[:, :-1], v[:, :-1], v[:, 1:], w[:-1], w[1:], steps)
    rate = _rate(costs, minimise)
    ends, middles = rate.map(count + 1)(v, w), rate.map(count)(0.5 * (v[:-1] + v[1:]), 0.5 * (w[:-1] + w[1:]))
    # Simpson's rule
    cost = steps / 6 * (ends[:-1] + 4 * middles + ends[1:])
    change = w[1:] - w[:-1]
    size = _search_objective(costs, minimise, schedule)
    rough = ca.sumsqr(change / max(float(np.abs(schedule.max_yaw_rate).max()), 1e-6))
    goals = [ca.vec(predicted - x[:, 1:]), x[:, 0] - start, x[:, -1] - goal]
    zeros = 3 * count + 6
    for leg, point in enumerate(via):
        node = int(np.flatnonzero(schedule.legs == leg)[-1]) + 1
        goals.append(x[:2, node] - point)
        zeros += 2
    limit = motion.yaw_acceleration * steps
    constraints = [*goals, ca.vec(limit - change), ca.vec(limit + change)]
    halves = _half_planes(x, clearance, count) if clearance is not None else None
    planes: Any = ca.MX(0, 1)
    if halves is not None:
        planes, clearances = halves
        constraints.append(clearances)
    g = ca.vertcat(*constraints)
    unknown = ca.vertcat(ca.vec(x), ca.vec(w), d)
    nlp = {"x": unknown, "f": ca.sum2(cost) / size + polish_settings.smoothness * rough, "g": g, "p": planes}
    solver = ca.nlpsol("polish", "ipopt", nlp, _options(polish_settings.iterations))
    min_durations = np.where(schedule.free, _MIN_PHASE, schedule.durations)
    max_durations = np.where(schedule.free, _MAX_RATIO * schedule.durations + 3.0, schedule.durations)
    lower = np.concatenate([np.full(3 * (count + 1), -np.inf), -schedule.max_yaw_rate, min_durations])
    upper = np.concatenate([np.full(3 * (count + 1), np.inf), schedule.max_yaw_rate, max_durations])
    guess = np.concatenate([schedule.poses.ravel(), schedule.yaw_rates, schedule.durations])
    lbg = np.zeros(g.shape[0])
    ubg = np.concatenate([np.zeros(zeros), np.full(g.shape[0] - zeros, np.inf)])
    status, solved = "", False
    for _ in range(polish_settings.rounds if clearance is not None else 1):
        poses = guess[: 3 * (count + 1)].reshape(-1, 3)
        p = np.zeros(0) if clearance is None else _planes_at(clearance, poses, settings)
        solution = solver(x0=guess, lbx=lower, ubx=upper, lbg=lbg, ubg=ubg, p=p)
        status, solved = solver.stats()["return_status"], solver.stats()["return_status"] in _SOLVED
        max_change = np.abs(np.array(solution["x"]).ravel() - guess)[: 3 * (count + 1)].max()
        guess = np.array(solution["x"]).ravel()
        if not solved:
            break
        if max_change < 0.02:
            break
    rates = guess[3 * (count + 1) : 4 * count + 4]
    return Polished(
        guess[4 * count + 4 :], np.clip(rates, -schedule.max_yaw_rate, schedule.max_yaw_rate), status, solved
    )


def _options(iterations: int) -> dict[str, Any]:
    return {
        "print_time": False,
        "ipopt": {
            "print_level": 0,
            "sb": "yes",
            "max_iter": iterations,
            "tol": 1e-5,
            "acceptable_tol": 1e-3,
            "acceptable_constr_viol_tol": 1e-6,
            "acceptable_iter": 8,
            "mu_strategy": "adaptive",
        },
    }


def _interval(costs: TurnCosts) -> ca.Function:
    """Build the step of the pose between nodes by the fourth-order Runge-Kutta method."""
    x, step = ca.SX.sym("x", 3), ca.SX.sym("h")
    v0, v1, w0, w1 = (ca.SX.sym(name) for name in ("v0", "v1", "w0", "w1"))

    def slope(pose: ca.SX, v: ca.SX, w: ca.SX) -> ca.SX:
        along, left, turn = polynomial_terms(costs.slip.rows, v, w)
        c, s = ca.cos(pose[2]), ca.sin(pose[2])
        return ca.SX(ca.vertcat(c * along - s * left, s * along + c * left, turn))

    vm, wm = 0.5 * (v0 + v1), 0.5 * (w0 + w1)
    k1 = slope(x, v0, w0)
    k2 = slope(x + 0.5 * step * k1, vm, wm)
    k3 = slope(x + 0.5 * step * k2, vm, wm)
    k4 = slope(x + step * k3, v1, w1)
    after = ca.SX(x + step / 6 * (k1 + 2 * k2 + 2 * k3 + k4))

    return ca.Function("interval", [x, v0, v1, w0, w1, step], [after])


def _rate(costs: TurnCosts, minimise: Objective) -> ca.Function:
    """Build the objective per second for a command."""
    v, w = ca.SX.sym("v"), ca.SX.sym("w")
    along, left, _ = polynomial_terms(costs.slip.rows, v, w)
    rate = ca.SX(1.0)
    if minimise == "energy":
        rate = costs.symbolic_power(v, w)
    elif minimise == "distance":
        rate = ca.sqrt(along**2 + left**2 + 1e-8)
    return ca.Function("rate", [v, w], [rate])


def _search_objective(costs: TurnCosts, minimise: Objective, schedule: Schedule) -> float:
    """Compute the objective of the search, which scales the objective of the solver to about one."""
    if minimise == "time":
        return float(schedule.durations.sum())
    commands = np.stack([schedule.speeds, schedule.yaw_rates], -1)[1:]
    rates = costs.power(commands) if minimise == "energy" else np.abs(commands[:, 0])
    return max(float(rates @ schedule.steps(schedule.durations)), 1e-3)


def _half_planes(x: Any, clearance: Clearance, count: int) -> tuple[Any, Any]:  # noqa: ANN401 - CasADi's symbols
    """Build parameters and values of the half-planes n . p >= b for each disc at each node."""
    rows = len(clearance.robot) * _NEAREST
    planes = ca.MX.sym("planes", 3 * rows, count + 1)
    c, s = ca.cos(x[2, :]), ca.sin(x[2, :])
    values = []
    for i in range(rows):
        ahead, left, _ = clearance.robot[i // _NEAREST]
        px, py = x[0, :] + c * ahead - s * left, x[1, :] + s * ahead + c * left
        values.append(planes[3 * i, :] * px + planes[3 * i + 1, :] * py - planes[3 * i + 2, :])
    return ca.vec(planes), ca.vec(ca.vertcat(*values))


def _planes_at(clearance: Clearance, poses: FloatArray, settings: PlanSettings) -> FloatArray:
    """Compute the half-planes at the nearest obstacles for poses (n + 1, 3)."""
    points = clearance.centres(poses)
    nodes, discs = points.shape[:2]
    gaps, away = clearance.nearest(points.reshape(-1, 2))
    required = settings.motion.margin + settings.polish.sag
    planes = np.zeros((nodes, discs * _NEAREST, 3))
    planes[..., 2] = -1.0
    order = np.argsort(gaps, axis=1, kind="stable")[:, :_NEAREST]
    for k in range(order.shape[1]):
        which = order[:, k]
        rows = np.arange(len(which))
        gap, unit = gaps[rows, which], away[rows, which]
        beyond = (unit * points.reshape(-1, 2)).sum(-1) - gap + np.tile(clearance.robot[:, 2], nodes) + required
        near = gap < _WITHIN
        plane = np.where(near[:, None], np.column_stack([unit, beyond]), [0.0, 0.0, -1.0])
        planes[:, k::_NEAREST, :] = plane.reshape(nodes, discs, 3)
    # Start and goal have no half-planes, because both poses are fixed and already checked.
    planes[[0, -1]] = (0.0, 0.0, -1.0)
    return planes.reshape(nodes, -1).ravel()
