"""Solve with OSQP, an operator-splitting method, driven directly and warm-started.

Variables are (U, p, m): p, m >= 0 take up what exceeds the soft limits upwards and downwards.
"""

from __future__ import annotations

import numpy as np
import osqp
from numpy.typing import NDArray
from scipy import sparse

from models.interface import FloatArray
from mpc.config import Solver, Weights
from mpc.qp.backend import Answer, Task
from mpc.qp.limit_rows import HARD_KINDS, KINDS, LimitRows
from mpc.qp.osqp_status import OSQP_STATUS
from mpc.quadratic_program import Kinds
from mpc.solver_report import SolverReport, SolverStatus

# A multiplier below this is what is left of one: its limit is not active.
_NO_PRESSURE = 1e-6


class OsqpBackend:
    """A work space for each set of soft limits that has mattered so far; implements `mpc.qp.backend.Backend`."""

    def __init__(self, steps: int, settings: Solver, weights: Weights) -> None:
        self._steps, self._settings, self._weights = steps, settings, weights
        self._workspaces: dict[Kinds, _Workspace] = {}

    def solve(self, task: Task) -> Answer:
        """See `mpc.qp.backend.Backend`; all hard limits are kept, their rows are sparse."""
        kinds = tuple(kind for kind in task.kinds if kind >= HARD_KINDS)
        workspace = self._workspaces.get(kinds)
        if workspace is None:
            workspace = self._workspaces[kinds] = _Workspace(self._steps, self._settings, self._weights, kinds)
        return workspace.solve(task)


class _Workspace:
    """One OSQP instance of fixed sparsity: range rows, increment rows, soft rows, the slacks' bounds."""

    def __init__(self, steps: int, settings: Solver, weights: Weights, kinds: Kinds) -> None:
        self._n = n = 2 * steps
        self._steps, self._kinds, self._weights, self._settings = steps, list(kinds), weights, settings
        self._limits = LimitRows(steps)
        self._soft_rows = rows = len(kinds) * steps
        # Commands are interleaved and rows go by kind: the commands of one channel are every second one.
        channels = sparse.vstack([sparse.identity(n, format="csr")[i::2] for i in (0, 1)])
        increments = sparse.block_diag([sparse.identity(steps) - sparse.eye(steps, k=-1)] * 2) @ channels
        hard = sparse.vstack([channels, increments])
        pattern = np.ones((rows, n))
        unit = sparse.identity(rows)
        blocks = [[hard, None, None], [pattern, -unit, unit], [None, unit, None], [None, None, unit]]
        self._A = _sorted_csc(sparse.bmat(blocks) if rows else hard)
        # Where the changing block of A lies among its stored values: the columns of U hold it below the hard rows.
        self._soft_place = _positions(self._A, 2 * n, rows, n) if rows else np.empty((0, n), dtype=np.intp)
        slack = np.full(2 * rows, weights.soft_quadratic)
        triangle = sparse.csc_matrix(np.triu(np.ones((n, n))))
        self._P = _sorted_csc(sparse.block_diag([triangle, sparse.diags(slack)]) if rows else triangle)
        # Column by column of the upper triangle, as places in the flattened matrix.
        column = np.repeat(np.arange(n), np.arange(1, n + 1))
        self._triangle = n * np.concatenate([np.arange(k + 1) for k in range(n)]) + column
        self._gradient = np.full(n + 2 * rows, weights.soft)
        self._lower = np.zeros(2 * n + 3 * rows)
        self._upper = np.full(2 * n + 3 * rows, np.inf)
        self._solver: osqp.OSQP | None = None

    def solve(self, task: Task) -> Answer:
        """Solve with the soft limits of this work space."""
        self._load(task)
        try:
            if self._solver is None:
                self._solver = self._set_up()
            else:
                changed = {"Ax": self._A.data} if self._kinds else {}
                self._solver.update(q=self._gradient, l=self._lower, u=self._upper, Px=self._P.data, **changed)
        except (osqp.OSQPException, ValueError):
            refused = SolverReport(SolverStatus.REFUSED, soft_limits=bool(self._kinds))
            return Answer(task.guess, refused, task.multipliers, ())
        self._solver.warm_start(x=self._primal(task), y=self._dual(task.multipliers))
        result = self._solver.solve(raise_error=False)
        report = SolverReport(
            status=OSQP_STATUS.get(result.info.status_val, SolverStatus.NOT_RUN),
            iterations=int(result.info.iter),
            primal_residual=float(result.info.prim_res),
            dual_residual=float(result.info.dual_res),
            soft_limits=bool(self._kinds),
        )
        multipliers = self._multipliers(result.y)
        kinds = tuple(np.flatnonzero(multipliers.any(axis=1)).tolist())
        return Answer(np.array(result.x[: self._n]), report, multipliers, kinds)

    def _load(self, task: Task) -> None:
        n, rows, limits = self._n, self._soft_rows, self._limits
        limits.load(task.qp)
        self._P.data[: len(self._triangle)] = task.qp.H.reshape(-1)[self._triangle]
        self._gradient[:n] = task.qp.g
        self._upper[: 2 * n] = limits.upper[:HARD_KINDS].reshape(-1)
        self._lower[: 2 * n] = limits.lower[:HARD_KINDS].reshape(-1)
        # The first increments count from the last command.
        first = slice(n, 2 * n, self._steps)
        self._upper[first] += task.qp.last_command
        self._lower[first] += task.qp.last_command
        if rows:
            self._upper[2 * n : 2 * n + rows] = limits.upper[self._kinds].reshape(-1)
            self._lower[2 * n : 2 * n + rows] = limits.lower[self._kinds].reshape(-1)
            soft = [task.qp.soft_rows(kind - HARD_KINDS) for kind in self._kinds]
            self._A.data[self._soft_place] = np.concatenate(soft)

    def _set_up(self) -> osqp.OSQP:
        solver = osqp.OSQP()
        solver.setup(
            self._P,
            self._gradient,
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

    def _primal(self, task: Task) -> FloatArray:
        if not self._kinds:
            return task.guess
        excess = self._limits.values(task.guess)[self._kinds]
        over = np.maximum(excess - self._limits.upper[self._kinds], 0)
        under = np.maximum(self._limits.lower[self._kinds] - excess, 0)
        return np.concatenate([task.guess, over.reshape(-1), under.reshape(-1)])

    def _dual(self, multipliers: FloatArray) -> FloatArray:
        """Multipliers of all rows; a slack's bound presses with what its limit leaves of the price."""
        hard, soft = multipliers[:HARD_KINDS].reshape(-1), multipliers[self._kinds].reshape(-1)
        price = self._weights.soft
        return np.concatenate([hard, soft, np.minimum(soft - price, 0), np.minimum(-soft - price, 0)])

    def _multipliers(self, dual: FloatArray) -> FloatArray:
        found = np.zeros((KINDS, self._steps))
        rows = 2 * self._n
        pressing = np.where(np.abs(dual) < _NO_PRESSURE, 0.0, dual)
        found[:HARD_KINDS] = pressing[:rows].reshape(HARD_KINDS, -1)
        found[self._kinds] = pressing[rows : rows + self._soft_rows].reshape(-1, self._steps)
        return found


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
