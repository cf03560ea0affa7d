"""Solve with OSQP, an operator-splitting method, driven directly and warm-started.

Variables are (U, p, m): p, m >= 0 take up what exceeds the soft limits upwards and downwards.
"""

from __future__ import annotations

from functools import lru_cache, partial

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.mpc.config.schema import Weights
from diffdrive_mpc.mpc.config.solver import Solver
from diffdrive_mpc.mpc.qp.backend import MOST_WORKSPACES, Answer, Task
from diffdrive_mpc.mpc.qp.limit_rows import HARD_KINDS, KINDS, LimitRows
from diffdrive_mpc.mpc.qp.osqp_instance import OsqpInstance
from diffdrive_mpc.mpc.quadratic_program import Kinds
from diffdrive_mpc.mpc.solver_report import SolverStatus

# A multiplier below this is what is left of one: its limit is not active.
_NO_PRESSURE = 1e-6


class OsqpBackend:
    """A work space for each of the sets of limits that mattered lately; implements `mpc.qp.backend.Backend`."""

    def __init__(self, steps: int, settings: Solver, weights: Weights) -> None:
        self._workspace = lru_cache(MOST_WORKSPACES)(partial(_Workspace, steps, settings, weights))

    def solve(self, task: Task) -> Answer:
        """See `mpc.qp.backend.Backend`."""
        return self._workspace(task.kinds).solve(task)


class _Workspace:
    """One OSQP instance of fixed sparsity: rows of hard limits, of soft ones, and bounds of their slacks."""

    def __init__(self, steps: int, settings: Solver, weights: Weights, kinds: Kinds) -> None:
        self._n, self._steps, self._weights = 2 * steps, steps, weights
        self._kinds, self._soft = list(kinds), [kind for kind in kinds if kind >= HARD_KINDS]
        self._limits = LimitRows(steps)
        # The rows of U are the chosen kinds', hard ones before soft ones.
        n, self._rows, rows = self._n, steps * len(kinds), steps * len(self._soft)
        # Commands are interleaved and rows go by kind: the commands of one channel are every second one.
        channels = [sparse.identity(n, format="csr")[i::2] for i in (0, 1)]
        difference = sparse.identity(steps) - sparse.eye(steps, k=-1)
        hard_rows = [*channels, *(difference @ channel for channel in channels)]
        hard = [[hard_rows[kind], None, None] for kind in kinds if kind < HARD_KINDS]
        pattern = np.ones((rows, n))
        unit = sparse.identity(rows)
        slacks = [[pattern, -unit, unit], [None, unit, None], [None, None, unit]] if rows else []
        blocks = [*hard, *slacks] if rows else [row[:1] for row in hard]
        self._A = _sorted_csc(sparse.bmat(blocks))
        # Where the changing block of A lies among its stored values: the columns of U hold it below the hard rows.
        self._soft_place = _positions(self._A, self._rows - rows, rows, n) if rows else np.empty((0, n), dtype=np.intp)
        slack = np.full(2 * rows, weights.soft_quadratic)
        triangle = sparse.csc_matrix(np.triu(np.ones((n, n))))
        self._P = _sorted_csc(sparse.block_diag([triangle, sparse.diags(slack)]) if rows else triangle)
        # Column by column of the upper triangle, as places in the flattened matrix.
        column = np.repeat(np.arange(n), np.arange(1, n + 1))
        self._triangle = n * np.concatenate([np.arange(k + 1) for k in range(n)]) + column
        self._gradient = np.full(n + 2 * rows, weights.soft)
        self._lower = np.zeros(self._rows + 2 * rows)
        self._upper = np.full(self._rows + 2 * rows, np.inf)
        self._osqp = OsqpInstance(self._P, self._A, settings, soft_limits=rows > 0, rows_change=rows > 0)

    def solve(self, task: Task) -> Answer:
        """Solve for the kinds of this work space."""
        self._load(task)
        x, y, report = self._osqp.solve(
            self._gradient, self._lower, self._upper, self._primal(task), self._dual(task.multipliers)
        )
        if report.status is SolverStatus.REFUSED:
            return Answer(task.guess, report, task.multipliers, ())
        multipliers = self._multipliers(y)
        kinds = tuple(np.flatnonzero(multipliers.any(axis=1)).tolist())
        return Answer(x[: self._n], report, multipliers, kinds)

    def _load(self, task: Task) -> None:
        n, limits, last = self._n, self._limits, task.qp.last_command
        limits.load(task.qp)
        self._P.data[: len(self._triangle)] = task.qp.H.reshape(-1)[self._triangle]
        self._gradient[:n] = task.qp.g
        for bound, values in ((self._upper, limits.upper), (self._lower, limits.lower)):
            # The first increments count from the last command.
            values[2:HARD_KINDS, 0] += last
            bound[: self._rows] = values[self._kinds].reshape(-1)
            values[2:HARD_KINDS, 0] -= last
        if self._soft:
            soft = [task.qp.soft_rows(kind - HARD_KINDS) for kind in self._soft]
            self._A.data[self._soft_place] = np.concatenate(soft)

    def _primal(self, task: Task) -> FloatArray:
        if not self._soft:
            return task.guess
        values = self._limits.values(task.guess)[self._soft]
        over = np.maximum(values - self._limits.upper[self._soft], 0)
        under = np.maximum(self._limits.lower[self._soft] - values, 0)
        return np.concatenate([task.guess, over.reshape(-1), under.reshape(-1)])

    def _dual(self, multipliers: FloatArray) -> FloatArray:
        """Multipliers of all rows; a slack's bound presses with what its limit leaves of the price."""
        pressing, soft = multipliers[self._kinds].reshape(-1), multipliers[self._soft].reshape(-1)
        price = self._weights.soft
        return np.concatenate([pressing, np.minimum(soft - price, 0), np.minimum(-soft - price, 0)])

    def _multipliers(self, dual: FloatArray) -> FloatArray:
        found = np.zeros((KINDS, self._steps))
        pressing = dual[: self._rows]
        found[self._kinds] = np.where(np.abs(pressing) < _NO_PRESSURE, 0.0, pressing).reshape(-1, self._steps)
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
