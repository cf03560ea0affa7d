"""The same quadratic program with states and poses as variables and the dynamics as equations, by OSQP."""

from __future__ import annotations

import numpy as np
import osqp
from scipy import sparse

from diffdrive_mpc.models.interface import FloatArray
from oracle.motion import arc, linearised, sideways, slid
from oracle.problem import TrackingProblem
from oracle.tick import Tick


class _Rows:
    """lower <= A z <= upper, row by row."""

    def __init__(self, columns: int) -> None:
        self.columns, self.rows, self.lower, self.upper = columns, [], [], []

    def add(self, lower: FloatArray, upper: FloatArray, *terms: tuple[FloatArray, FloatArray]) -> None:
        """Rows whose values are the sum of matrix @ z[columns] over `terms`."""
        block = np.zeros((np.size(lower), self.columns))
        for matrix, columns in terms:
            block[:, np.ravel(columns)] += matrix
        self.rows.append(sparse.csc_matrix(block))
        self.lower.append(np.ravel(lower))
        self.upper.append(np.ravel(upper))


def solve_sparse(problem: TrackingProblem, tick: Tick, plan: FloatArray) -> FloatArray:
    """(N, 2) the solution of the problem linearised along `plan` (N, 2)."""
    N, model, slip = problem.steps, problem.model, tick.slip
    n, I2, I3 = model.order, np.eye(2), np.eye(3)
    sizes = {"sent": (len(tick.past) + N, 2), "x": (N + 1, n), "y": (N + 1, 2), "pose": (N + 1, 3), "e": (5, N)}
    ends = np.cumsum([np.prod(shape) for shape in sizes.values()])
    at = {
        name: np.arange(end - np.prod(shape), end).reshape(shape)
        for (name, shape), end in zip(sizes.items(), ends, strict=True)
    }
    u = at["sent"][len(tick.past) :]
    rows, columns = _Rows(int(ends[-1])), int(ends[-1])
    rows.add(tick.past, tick.past, (np.eye(tick.past.size), at["sent"][: len(tick.past)]))
    rows.add(tick.state, tick.state, (np.eye(n), at["x"][0]))
    rows.add(tick.pose, tick.pose, (I3, at["pose"][0]))
    nominal = problem.twists(tick, plan[:, :, None])
    ahead = problem.turning_points(tick, plan)
    theta = problem.poses(tick, nominal, ahead)[:, 2, 0]
    gain = np.array([[slip.gains[0], slip.turn_left * slip.gains[1]], [0.0, slip.gains[1]]])
    for k in range(N + 1):
        # The body's twist y = gain (C x + offset).
        constant = gain @ slip.offset
        rows.add(constant, constant, (I2, at["y"][k]), (-gain @ model.C, at["x"][k]))
    for k in range(N):
        recent = [at["sent"][len(tick.past) + k - model.delay[j], j] for j in (0, 1)]
        older = [at["sent"][len(tick.past) + k - model.delay[j] - 1, j] for j in (0, 1)]
        none, x, pose, y = np.zeros(n), at["x"], at["pose"], at["y"]
        rows.add(none, none, (np.eye(n), x[k + 1]), (-model.A, x[k]), (-model.B0, recent), (-model.B1, older))
        where = np.array([theta[k], *(0.5 * (nominal[k, :, 0] + nominal[k + 1, :, 0]))])

        def moving(q: FloatArray, lever: float = ahead[k]) -> FloatArray:
            dx, dy = slid(q[0], q[2], model.dt, (slip.slide_x, slip.slide_y))
            return np.stack(arc(*q, model.dt, sideways(q[1], q[2], slip.side_slip, lever))) + np.stack([dx, dy, 0 * dx])

        move, J = linearised(moving, where)
        moved = move - J @ where
        by_twist, by_heading = -0.5 * J[:, 1:], -np.outer(J[:, 0], [0, 0, 1])
        rows.add(moved, moved, (I3, pose[k + 1]), (by_heading - I3, pose[k]), (by_twist, y[k]), (by_twist, y[k + 1]))
    hard, lower, upper = problem.hard_limits(tick)
    rows.add(lower, upper, (hard, u))
    _soft_limits(problem, tick, rows, at)
    P, q = _cost(problem, tick, at, columns)
    solver = osqp.OSQP()
    A = sparse.csc_matrix(sparse.vstack(rows.rows))
    solver.setup(
        sparse.csc_matrix(sparse.triu(P)),
        q,
        A,
        np.concatenate(rows.lower),
        np.concatenate(rows.upper),
        verbose=False,
        eps_abs=1e-9,
        eps_rel=1e-9,
        max_iter=200_000,
        polishing=True,
    )
    result = solver.solve(raise_error=False)
    assert result.info.status_val == osqp.SolverStatus.OSQP_SOLVED, result.info.status
    return np.asarray(result.x[u])


def _across(theta: float) -> FloatArray:
    return np.array([[-np.sin(theta), np.cos(theta), 0.0]])


def _soft_limits(problem: TrackingProblem, tick: Tick, rows: _Rows, at: dict[str, FloatArray]) -> None:
    _, now = problem.outcome(tick, np.zeros((problem.steps, 2, 1)), np.zeros(problem.steps))
    limits, half = problem.soft_limits(now[:, 0, 0]), 0.5 * problem.config.wheels.track
    v, omega = 1 / tick.slip.gains
    turn = v * tick.slip.turn_left
    by_twist = np.array([[1, 0], [0, 1], [v, half * omega - turn], [v, -half * omega - turn]])
    unit, none = np.eye(1), np.full(1, np.inf)
    for k in range(1, problem.steps + 1):
        across = _across(tick.aim[k, 2])
        for kind, limit in enumerate(limits):
            value, offset = (by_twist[kind : kind + 1], at["y"][k]), 0.0
            if kind == 4:
                value, offset = (across, at["pose"][k]), (across @ tick.aim[k]).item()
            excess = at["e"][kind, k - 1]
            rows.add(-none, offset + limit * np.ones(1), value, (-unit, excess))
            rows.add(offset - limit * np.ones(1), none, value, (unit, excess))
    rows.add(np.zeros(at["e"].size), np.full(at["e"].size, np.inf), (np.eye(at["e"].size), at["e"]))


def _cost(
    problem: TrackingProblem, tick: Tick, at: dict[str, FloatArray], columns: int
) -> tuple[FloatArray, FloatArray]:
    """P and q of z'Pz/2 + q'z: half the weighted squares of M z - wanted, over all terms."""
    N, w = problem.steps, problem.config.weights
    P, q, u = np.zeros((columns, columns)), np.zeros(columns), at["sent"][-N:]

    def add(M: FloatArray, where: FloatArray, wanted: FloatArray, weights: FloatArray) -> None:
        place = np.ravel(where)
        P[np.ix_(place, place)] += M.T @ np.diag(weights) @ M
        q[place] -= M.T @ (weights * wanted)

    for k in range(1, N + 1):
        x, y, theta = tick.aim[k]
        M = np.vstack([[np.cos(theta), np.sin(theta), 0], _across(theta), [0, 0, 1]])
        weights = np.array([w.along, w.across, w.heading]) * (w.terminal if k == N else 1.0)
        add(M, at["pose"][k], M @ [x, y, tick.heading[k]], weights)
    add(np.eye(2 * N), u, tick.feed_forward.ravel(), np.tile([w.v, w.omega], N))
    difference = np.eye(2 * N) - np.eye(2 * N, k=-2)
    first = np.concatenate([tick.last_command, np.zeros(2 * N - 2)])
    add(difference, u, first, np.tile([w.v_increment, w.omega_increment], N))
    e = at["e"].ravel()
    P[e, e] += w.soft_quadratic
    q[e] += w.soft
    return P, q
