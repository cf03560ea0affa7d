"""Backend for OSQP, a warm-started operator-splitting method.

The variables are (U, p, m); the slacks p, m >= 0 are the violations of the upper and lower soft limits. The rows of a
soft limit and their slacks are divided by the maximum entry of these rows. Without this scaling, OSQP needs ten times
as many iterations while limits are active. The work space of the hard limits is set up with the controller, and the
work space of a set of soft limits at its first use.
"""

from __future__ import annotations

import time
from functools import cache, partial

import numpy as np
import osqp
from numpy.typing import NDArray
from scipy import sparse

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.mpc.config.schema import Weights
from diffdrive_mpc.mpc.config.solver import Solver
from diffdrive_mpc.mpc.problem.constants import HARD_KINDS as HARD
from diffdrive_mpc.mpc.solver.backend import MIN_TIME_LIMIT, Kinds, Program, SetUpTime, Solved
from diffdrive_mpc.mpc.solver.report import SolverStatus

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
# Minimum multiplier of an active limit; smaller multipliers are numerical noise.
_MIN_MULTIPLIER = 1e-6
# Time limit that OSQP treats as none, its default [s].
_NO_TIME_LIMIT = 1e10
# Maximum number of work spaces; few sets of soft limits occur in practice.
_MAX_WORKSPACES = 16


class _SetUpTimes:
    """Measured times of the set-up of the hard limits' work space, and of the factorisation of new data."""

    def __init__(self) -> None:
        self.set_up, self.update = SetUpTime(), SetUpTime()


@cache
def _set_up_times(_steps: int) -> _SetUpTimes:
    return _SetUpTimes()


class OsqpBackend:
    """Implementation of `mpc.solver.backend.Backend` with OSQP."""

    def __init__(self, steps: int, kinds: int, settings: Solver, weights: Weights) -> None:
        self._count, self._steps, self._set_up_times = kinds, steps, _set_up_times(steps)
        self._create_workspace = partial(_Workspace, steps, kinds, settings, weights, self._set_up_times.update)
        self._workspaces: dict[Kinds, _Workspace] = {}
        # The first set-up in a process also loads the library, so the measurement is repeated.
        for _ in range(1 if self._set_up_times.set_up.expected() else 2):
            with self._set_up_times.set_up.measured():
                self._workspaces[()] = self._create_workspace(())

    def solve(
        self,
        program: Program,
        kinds: Kinds,
        guess: FloatArray,
        multipliers: FloatArray,
        time_limit: float | None = None,
    ) -> Solved:
        """Solve the program, see `mpc.solver.backend.Backend`."""
        soft = tuple(kind for kind in kinds if kind >= HARD)
        deadline = None if time_limit is None else time.monotonic() + time_limit
        workspace = self._workspaces.get(soft)
        factorise = self._set_up_times.update.expected(_relative_work(soft))
        required_time = factorise if workspace else self._set_up_times.set_up.expected() + 2 * factorise
        if time_limit is not None and required_time >= time_limit:
            return Solved(guess, np.zeros((self._count, self._steps)), SolverStatus.TIME_LIMIT)
        if workspace is None:
            if len(self._workspaces) >= _MAX_WORKSPACES:
                # The first entry is the work space of the hard limits; delete the oldest of the others.
                del self._workspaces[list(self._workspaces)[1]]
            workspace = self._workspaces[soft] = self._create_workspace(soft)
        return workspace.solve(program, guess, multipliers, deadline)


def _relative_work(soft: Kinds) -> float:
    """Return the factorisation time relative to that without soft limits; rows of soft limits are dense."""
    return (1.0 + 0.5 * len(soft)) ** 2


class _Workspace:
    """OSQP instance of fixed sparsity, with rows of the hard limits, of a set of soft limits, and of slack bounds."""

    def __init__(
        self, steps: int, count: int, settings: Solver, weights: Weights, update_time: SetUpTime, soft: Kinds
    ) -> None:
        self._update_time, self._size_of_update = update_time, _relative_work(soft)
        self._n, self._steps, self._count, self._weights = 2 * steps, steps, count, weights
        kinds = [*range(HARD), *soft]
        # A slice is faster than a list.
        self._soft, self._kinds = list(soft), kinds if soft else slice(HARD)
        # The rows of the hard limits are followed by the rows of the soft limits.
        n, self._rows, rows = self._n, steps * len(kinds), steps * len(soft)
        # The two channels of the commands are interleaved, whereas rows are sorted by kind.
        channels = [sparse.identity(n, format="csr")[i::2] for i in (0, 1)]
        difference = sparse.identity(steps) - sparse.eye(steps, k=-1)
        hard = [[block, None, None] for block in (*channels, *(difference @ channel for channel in channels))]
        pattern, unit = np.ones((rows, n)), sparse.identity(rows)
        slacks = [[pattern, -unit, unit], [None, unit, None], [None, None, unit]] if rows else []
        blocks = [*hard, *slacks] if rows else [row[:1] for row in hard]
        self._A = _sorted_csc(sparse.bmat(blocks))
        # Indices of the soft rows of U in the stored values of A; all other values are constant.
        self._soft_indices = (
            _positions(self._A, self._rows - rows, rows, n) if rows else np.empty((0, n), dtype=np.intp)
        )
        # The sparsity pattern includes the off-diagonal entries, whose values are set at each tick.
        triangle = sparse.csc_matrix(np.triu(np.ones((n, n))))
        self._P = _sorted_csc(sparse.block_diag([triangle, sparse.identity(2 * rows)]) if rows else triangle)
        # Indices of the upper triangle in the flattened matrix, in column-major order.
        column = np.repeat(np.arange(n), np.arange(1, n + 1))
        self._triangle = n * np.concatenate([np.arange(k + 1) for k in range(n)]) + column
        self._gradient = np.zeros(n + 2 * rows)
        # Slice of the rows of the soft limits, and divisors of these rows.
        self._soft_rows, self._relative_work = slice(self._rows - rows, self._rows), np.ones(rows)
        self._lower = np.zeros(self._rows + 2 * rows)
        self._upper = np.full(self._rows + 2 * rows, np.inf)
        self._P.data[: len(self._triangle)] = np.eye(n).reshape(-1)[self._triangle]
        self._solver = self._set_up(settings)
        # The first solve of OSQP includes the set-up time, so the constructor calls it once.
        self._solver.solve(raise_error=False)
        self._update()
        self._time_limit = _NO_TIME_LIMIT

    def _set_up(self, settings: Solver) -> osqp.OSQP:
        solver = osqp.OSQP()
        solver.setup(
            self._P,
            self._gradient,
            self._A,
            self._lower,
            self._upper,
            verbose=False,
            **settings.osqp.model_dump(),
            # An adaptation interval in iterations, not in time, makes results independent of the computer.
            adaptive_rho=1,
            adaptive_rho_interval=50,
            polishing=False,
        )
        return solver

    def _update(self) -> None:
        changed = {"Ax": self._A.data} if self._soft else {}
        with self._update_time.measured(self._size_of_update):
            self._solver.update(q=self._gradient, l=self._lower, u=self._upper, Px=self._P.data, **changed)

    def solve(self, program: Program, guess: FloatArray, multipliers: FloatArray, deadline: float | None) -> Solved:
        """Solve with the limits of this work space; stop at `deadline` [s, `time.monotonic`]."""
        values = self._load(program, guess)
        # The time limit of OSQP starts with the update; OSQP checks it at every iteration.
        remaining = _NO_TIME_LIMIT if deadline is None else deadline - time.monotonic()
        time_limit = min(max(remaining, MIN_TIME_LIMIT), _NO_TIME_LIMIT)
        if time_limit != self._time_limit:
            self._solver.update_settings(time_limit=time_limit)
            self._time_limit = time_limit
        try:
            self._update()
        except (osqp.OSQPException, ValueError):
            return Solved(guess, np.zeros((self._count, self._steps)), SolverStatus.REFUSED)
        self._solver.warm_start(x=self._primal(guess, values), y=self._dual(multipliers))
        result = self._solver.solve(raise_error=False)
        info = result.info
        return Solved(
            np.array(result.x)[: self._n],
            self._multipliers(np.array(result.y)),
            _STATUS.get(info.status_val, SolverStatus.NOT_RUN),
            int(info.iter),
            float(info.prim_res),
            float(info.dual_res),
        )

    def _load(self, program: Program, guess: FloatArray) -> FloatArray:
        """Copy the data of the program; return the scaled values of the soft limits at `guess`."""
        n, entries = self._n, len(self._triangle)
        program.H.take(self._triangle, out=self._P.data[:entries])
        self._gradient[:n] = program.g
        self._upper[: self._rows] = program.upper[self._kinds].reshape(-1)
        self._lower[: self._rows] = program.lower[self._kinds].reshape(-1)
        if not self._soft:
            return np.empty(0)
        rows = np.stack([program.rows(kind) for kind in self._soft])
        max_entry = np.abs(rows).max(axis=(1, 2))
        size = self._relative_work = np.repeat(np.where(max_entry > 0.0, max_entry, 1.0), self._steps)
        scaled = rows.reshape(-1, n) / size[:, None]
        self._A.data[self._soft_indices] = scaled
        self._upper[self._soft_rows] /= size
        self._lower[self._soft_rows] /= size
        # A slack of a divided row is smaller by the divisor, so its linear price is multiplied by the divisor, and its
        # quadratic price by the squared divisor.
        self._P.data[entries:] = np.tile(self._weights.soft_quadratic * size**2, 2)
        self._gradient[n:] = np.tile(self._weights.soft * size, 2)
        values: FloatArray = scaled @ guess
        return values

    def _primal(self, guess: FloatArray, values: FloatArray) -> FloatArray:
        if not self._soft:
            return guess
        over = np.maximum(values - self._upper[self._soft_rows], 0)
        under = np.maximum(self._lower[self._soft_rows] - values, 0)
        return np.concatenate([guess, over, under])

    def _dual(self, multipliers: FloatArray) -> FloatArray:
        """Return the multipliers of all rows; the multiplier of a slack bound is that of its limit minus the price."""
        active = multipliers[self._kinds].reshape(-1)
        if not self._soft:
            return active
        soft = active[self._soft_rows]
        soft *= self._relative_work
        price = self._gradient[self._n :].reshape(2, -1)[0]
        return np.concatenate([active, np.minimum(soft - price, 0), np.minimum(-soft - price, 0)])

    def _multipliers(self, dual: FloatArray) -> FloatArray:
        multipliers = np.zeros((self._count, self._steps))
        active = dual[: self._rows]
        if self._soft:
            # The division of a row has multiplied its multiplier by the divisor.
            active[self._soft_rows] /= self._relative_work
        active[np.abs(active) < _MIN_MULTIPLIER] = 0.0
        multipliers[self._kinds] = active.reshape(-1, self._steps)
        return multipliers


def _sorted_csc(matrix: FloatArray | sparse.spmatrix) -> sparse.csc_matrix:
    """Convert to compressed columns with ascending row indices, the order in which OSQP expects new values."""
    result = sparse.csc_matrix(matrix)
    result.sort_indices()
    return result


def _positions(matrix: sparse.csc_matrix, first_row: int, rows: int, columns: int) -> NDArray[np.intp]:
    """Return the indices (rows, columns) in `matrix.data` of the dense block at `first_row` and column 0."""
    indices = matrix.copy()
    indices.data = np.arange(1, matrix.nnz + 1, dtype=float)
    return np.asarray(indices[first_row : first_row + rows, :columns].toarray() - 1, dtype=np.intp)
