"""Cold-start solution of the quadratic program with all limits, accurate to rounding, and its optimality check."""

from __future__ import annotations

from dataclasses import dataclass

import daqp
import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.mpc.solver.report import SolverStatus
from oracle.problem import QuadraticProgram

# Larger values are not plausible for a robot.
_MAX_VALUE = 1e15
_ACCURACY = 1e-9
_NO_BOUND = 1e30
# DAQP's flags of initially active rows.
_ACTIVE, _LOWER = 1, 2


@dataclass(frozen=True)
class Solution:
    """Solution: x (n,), and multipliers of hard and soft rows, positive at upper bounds."""

    status: SolverStatus
    x: FloatArray
    hard: FloatArray
    soft: FloatArray


def solve(qp: QuadraticProgram) -> Solution:
    """Return the verified solution, or a zero solution with the status NOT_FINITE.

    Raises
    ------
    AssertionError
        If the result of the solver is not optimal.
    """
    not_finite = Solution(
        SolverStatus.NOT_FINITE, np.zeros(len(qp.g)), np.zeros(len(qp.lower)), np.zeros(len(qp.soft_lower))
    )
    data = (qp.H, qp.g, qp.rows, qp.upper, qp.soft_rows, qp.soft_upper)
    if not all(np.vdot(part, part) < _MAX_VALUE**2 for part in data):
        return not_finite
    # Variables (e, x): e >= 0 is the excess of a soft row; the bounds e = 0 are initially active.
    n, hard, soft = len(qp.g), len(qp.lower), len(qp.soft_lower)
    scale, unit, unbounded = np.abs(qp.H).max(), np.eye(soft), np.full(soft, _NO_BOUND)
    H = np.zeros((soft + n, soft + n))
    H[:soft, :soft], H[soft:, soft:] = qp.quadratic * unit, qp.H
    f = np.concatenate([np.full(soft, qp.price), qp.g])
    rows = np.block([[np.zeros((hard, soft)), qp.rows], [-unit, qp.soft_rows], [unit, qp.soft_rows]])
    lower = np.concatenate([np.zeros(soft), qp.lower, -unbounded, qp.soft_lower])
    upper = np.concatenate([unbounded, qp.upper, qp.soft_upper, unbounded])
    sense = np.repeat([_ACTIVE | _LOWER, 0], [soft, hard + 2 * soft]).astype(np.intc)
    model = daqp.Model()
    model.setup(H / scale, f / scale, rows, upper, lower, sense)
    model.settings = {"primal_tol": 1e-12, "dual_tol": 1e-13, "zero_tol": 1e-13, "iter_limit": 100_000}
    z, _, flag, info = model.solve()
    assert flag == 1, f"DAQP returned {flag}"
    _, multipliers, over, under = np.split(scale * info["lam"], np.cumsum([soft, hard, soft]))
    solution = Solution(SolverStatus.SOLVED, z[soft:], multipliers, over + under)
    residual = optimality_residual(qp, solution)
    assert residual < _ACCURACY, f"off the optimum by {residual:.1e}"
    return solution


def optimality_residual(qp: QuadraticProgram, solution: Solution) -> float:
    """Compute the residual of the optimality conditions, in units of x [m/s, rad/s, m]; 0 at the solution.

    The conditions are: the cost is stationary, hard limits are satisfied, only active limits have multipliers, and the
    multiplier of a soft limit equals the marginal cost of its excess if exceeded, and is at most its price otherwise.
    """
    x, soft_values, values = solution.x, qp.soft_rows @ solution.x, qp.rows @ solution.x
    gradient = qp.H @ x + qp.g + solution.hard @ qp.rows + solution.soft @ qp.soft_rows
    result = [np.linalg.solve(qp.H, gradient), _violation(values, qp.lower, qp.upper)]
    result += [_gap(solution.hard, values, qp.lower, qp.upper)]
    over, under = np.maximum(soft_values - qp.soft_upper, 0), np.maximum(qp.soft_lower - soft_values, 0)
    # With its excess removed, a soft limit is a hard limit whose multiplier is bounded by its price.
    result += [_gap(solution.soft, soft_values - over + under, qp.soft_lower, qp.soft_upper)]
    price = qp.price + qp.quadratic * (over + under)
    deviation = np.where(
        over + under > _ACCURACY, price - np.abs(solution.soft), np.maximum(np.abs(solution.soft) - price, 0)
    )
    # Within the dead time no command acts on the row, so a missing multiplier has no effect.
    soft_residual = deviation * np.abs(qp.soft_rows).max(axis=1) / np.abs(qp.H).max()
    return float(max(np.abs(part).max() for part in [*result, soft_residual]))


def _violation(values: FloatArray, lower: FloatArray, upper: FloatArray) -> FloatArray:
    return np.maximum(np.maximum(values - upper, lower - values), 0)


def _gap(multipliers: FloatArray, values: FloatArray, lower: FloatArray, upper: FloatArray) -> FloatArray:
    """Compute the distance from the bound of each active row; 0 if inactive."""
    gap = np.where(multipliers > 0, upper - values, values - lower)
    return np.where(np.abs(multipliers) > 1e-9 * (1 + np.abs(multipliers).max()), gap, 0.0)
