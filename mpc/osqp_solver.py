"""Solve the condensed problem with OSQP, driven directly and warm-started from the shifted plan.

Soft limits rarely matter, and their rows and slacks make the problem several times larger. So the problem is first
solved without those that were inactive at the last tick. If its solution keeps them all, it solves the whole problem
too; if not, the kinds of limit that it breaks are added and it is solved again.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import osqp
from numpy.typing import NDArray
from scipy import sparse

from models.interface import FloatArray
from mpc.config import Solver, Weights
from mpc.quadratic_program import QuadraticProgram
from mpc.solver_report import SolverReport, SolverStatus

_STATUS = {
    osqp.SolverStatus.OSQP_SOLVED: SolverStatus.SOLVED,
    osqp.SolverStatus.OSQP_SOLVED_INACCURATE: SolverStatus.SOLVED_INACCURATELY,
    osqp.SolverStatus.OSQP_MAX_ITER_REACHED: SolverStatus.MAX_ITERATIONS,
    osqp.SolverStatus.OSQP_TIME_LIMIT_REACHED: SolverStatus.TIME_LIMIT,
    osqp.SolverStatus.OSQP_PRIMAL_INFEASIBLE: SolverStatus.INFEASIBLE,
    osqp.SolverStatus.OSQP_PRIMAL_INFEASIBLE_INACCURATE: SolverStatus.INFEASIBLE,
    osqp.SolverStatus.OSQP_DUAL_INFEASIBLE: SolverStatus.UNBOUNDED,
    osqp.SolverStatus.OSQP_DUAL_INFEASIBLE_INACCURATE: SolverStatus.UNBOUNDED,
    osqp.SolverStatus.OSQP_NON_CVX: SolverStatus.NOT_CONVEX,
}

# A soft limit exceeded by less than this counts as kept: it is the size of the solver's own residuals.
_SOFT_SLACK = 1e-6

# OSQP takes bounds beyond 1e30 for none, and refuses such an update without raising: it would solve the old problem.
_LARGEST = 1e15

Kinds = tuple[int, ...]
"""Which of the five kinds of soft limit a problem includes, ascending."""


@dataclass(frozen=True)
class Solution:
    """A plan and what the solver says of it; the plan means nothing unless `report.status.usable`.

    Attributes
    ----------
    plan
        (N, 2) v_ref [m/s], omega_ref [rad/s] for the next N ticks.
    report
        Status, iterations, residuals.
    """

    plan: FloatArray
    report: SolverReport


class OsqpSolver:
    """OSQP work spaces of fixed sparsity, one for each set of soft limits that has mattered so far."""

    def __init__(self, steps: int, settings: Solver, weights: Weights) -> None:
        self._steps = steps
        self._settings = settings
        self._weights = weights
        self.reset()

    def reset(self) -> None:
        """Forget every earlier solve; called after a failure, so that no bad iterate is carried on."""
        self._workspaces: dict[Kinds, _Workspace] = {}
        self._kinds: Kinds = ()

    def solve(self, qp: QuadraticProgram, guess: FloatArray) -> Solution:
        """Solve, starting from the plan `guess` (N, 2). Never raises on numbers: see the report's status."""
        # Written so that NaN fails the comparison.
        if not all((np.abs(data) < _LARGEST).all() for data in (qp.H, qp.g, qp.box, qp.last_command, qp.soft_upper)):
            return Solution(guess, SolverReport(SolverStatus.NOT_FINITE))
        iterations, kinds = 0, self._kinds
        while True:
            if kinds not in self._workspaces:
                self._workspaces[kinds] = _Workspace(self._steps, self._settings, self._weights, kinds)
            workspace = self._workspaces[kinds]
            x, report = workspace.solve(qp, guess, iterations)
            plan = x[: 2 * self._steps]
            missed = _exceeded(qp, plan) - set(kinds)
            if not report.status.usable or not missed:
                break
            iterations, kinds = report.iterations, tuple(sorted({*kinds, *missed}))
        self._kinds = workspace.active_kinds() if report.status.usable else ()
        return Solution(plan.reshape(-1, 2), report)


def _exceeded(qp: QuadraticProgram, plan: FloatArray) -> set[int]:
    """Kinds of soft limit that `plan` (2 N,) breaks somewhere."""
    rows = qp.soft @ plan
    broken = (rows > qp.soft_upper + _SOFT_SLACK) | (rows < qp.soft_lower - _SOFT_SLACK)
    return set(np.flatnonzero(broken.any(axis=1)).tolist())


class _Workspace:
    """One OSQP instance. Variables are (U, p, m): p, m >= 0 take up what exceeds the soft limits upwards, downwards."""

    def __init__(self, steps: int, settings: Solver, weights: Weights, kinds: Kinds) -> None:
        self._n = n = 2 * steps
        self._kinds = list(kinds)
        self._soft_rows = rows = len(kinds) * steps
        hard = sparse.vstack([sparse.identity(n), sparse.identity(n) - sparse.eye(n, k=-2)])
        pattern = np.ones((rows, n))
        unit = sparse.identity(rows)
        blocks = [[hard, None, None], [pattern, -unit, unit], [None, unit, None], [None, None, unit]]
        self._A = _sorted_csc(sparse.bmat(blocks) if rows else hard)
        # Where the changing block of A lies among its stored values: the columns of U hold it below the hard rows.
        self._soft_place = _positions(self._A, 2 * n, rows, n) if rows else np.empty((0, n), dtype=np.intp)
        slack = np.full(2 * rows, weights.soft_quadratic)
        triangle = sparse.csc_matrix(np.triu(np.ones((n, n))))
        self._P = _sorted_csc(sparse.block_diag([triangle, sparse.diags(slack)]) if rows else triangle)
        column = np.repeat(np.arange(n), np.arange(1, n + 1))
        self._triangle = (np.concatenate([np.arange(k + 1) for k in range(n)]), column)
        self._slack_cost = np.full(2 * rows, weights.soft)
        self._lower = np.zeros(2 * n + 3 * rows)
        self._upper = np.full(2 * n + 3 * rows, np.inf)
        self._settings = settings
        self._solver: osqp.OSQP | None = None
        self._dual = np.zeros(0)

    def solve(
        self, qp: QuadraticProgram, guess: FloatArray, earlier_iterations: int
    ) -> tuple[FloatArray, SolverReport]:
        """Primal solution (all variables) and report."""
        n, rows = self._n, self._soft_rows
        size = n * (n + 1) // 2
        self._P.data[:size] = qp.H[self._triangle]
        gradient = np.concatenate([qp.g, self._slack_cost])
        slew = np.tile(qp.slew, self._n // 2)
        self._upper[:n], self._upper[n : 2 * n] = qp.box, slew
        self._lower[:n], self._lower[n : 2 * n] = -qp.box, -slew
        self._upper[n : n + 2] += qp.last_command
        self._lower[n : n + 2] += qp.last_command
        if rows:
            self._upper[2 * n : 2 * n + rows] = qp.soft_upper[self._kinds].ravel()
            self._lower[2 * n : 2 * n + rows] = qp.soft_lower[self._kinds].ravel()
            self._A.data[self._soft_place] = qp.soft[self._kinds].reshape(rows, n)
        try:
            if self._solver is None:
                self._solver = self._set_up(gradient)
            else:
                changed = {"Ax": self._A.data} if rows else {}
                self._solver.update(q=gradient, l=self._lower, u=self._upper, Px=self._P.data, **changed)
        except (osqp.OSQPException, ValueError):
            return guess.ravel(), SolverReport(SolverStatus.REFUSED, soft_limits=rows > 0)
        self._solver.warm_start(x=self._start(qp, guess), y=self._shifted_dual())
        result = self._solver.solve(raise_error=False)
        status = _STATUS.get(result.info.status_val, SolverStatus.NOT_RUN)
        report = SolverReport(
            status=status,
            iterations=int(result.info.iter) + earlier_iterations,
            primal_residual=float(result.info.prim_res),
            dual_residual=float(result.info.dual_res),
            soft_limits=rows > 0,
        )
        if status.usable:
            self._dual = np.array(result.y)
        return np.array(result.x), report

    def active_kinds(self) -> Kinds:
        """The kinds of soft limit that the last solution leaned on."""
        n, rows = self._n, self._soft_rows
        multipliers = self._dual[2 * n : 2 * n + rows].reshape(len(self._kinds), n // 2)
        return tuple(
            kind for kind, row in zip(self._kinds, multipliers, strict=True) if np.abs(row).max() > _SOFT_SLACK
        )

    def _set_up(self, gradient: FloatArray) -> osqp.OSQP:
        solver = osqp.OSQP()
        solver.setup(
            self._P,
            gradient,
            self._A,
            self._lower,
            self._upper,
            verbose=False,
            eps_abs=self._settings.tolerance,
            eps_rel=self._settings.tolerance,
            max_iter=self._settings.max_iterations,
            check_termination=self._settings.check_every,
            # By iterations, not by time: a run must not depend on how fast the machine is.
            adaptive_rho=1,
            adaptive_rho_interval=50,
            polishing=False,
            **({} if self._settings.time_limit is None else {"time_limit": self._settings.time_limit}),
        )
        return solver

    def _start(self, qp: QuadraticProgram, guess: FloatArray) -> FloatArray:
        flat = guess.ravel()
        if not self._soft_rows:
            return flat
        rows = qp.soft[self._kinds] @ flat
        over = np.maximum(rows - qp.soft_upper[self._kinds], 0)
        under = np.maximum(qp.soft_lower[self._kinds] - rows, 0)
        return np.concatenate([flat, over.ravel(), under.ravel()])

    def _shifted_dual(self) -> FloatArray:
        """The multipliers of the last tick; those of hard limits move a step ahead like the plan."""
        if not self._dual.size:
            return np.zeros(len(self._lower))
        n, steps = self._n, self._n // 2
        return np.concatenate(
            [_shift(self._dual[:n], steps), _shift(self._dual[n : 2 * n], steps), self._dual[2 * n :]]
        )


def _shift(values: FloatArray, steps: int) -> FloatArray:
    rows = values.reshape(steps, -1)
    return np.concatenate([rows[1:], rows[-1:]]).ravel()


def _sorted_csc(matrix: FloatArray | sparse.spmatrix) -> sparse.csc_matrix:
    """Compressed columns with ascending rows: the order in which new values are written."""
    result = sparse.csc_matrix(matrix)
    result.sort_indices()
    return result


def _positions(matrix: sparse.csc_matrix, first_row: int, rows: int, columns: int) -> NDArray[np.intp]:
    """(rows, columns) places in `matrix.data` of the dense block that starts at `first_row` in the first column."""
    numbered = matrix.copy()
    numbered.data = np.arange(1, matrix.nnz + 1, dtype=float)
    return np.asarray(numbered[first_row : first_row + rows, :columns].toarray() - 1, dtype=np.intp)
