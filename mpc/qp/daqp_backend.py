"""Solve with DAQP, a dual active-set method, as a least-distance problem.

DAQP has nothing to factorise then. It begins from the limits that are taken to be active. Soft limits are its own: an
exact and a quadratic price on each row, without slack variables.
"""

from __future__ import annotations

from functools import lru_cache, partial
from typing import Any

import daqp
import numpy as np
from numpy.typing import NDArray

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.mpc.config.schema import Weights
from diffdrive_mpc.mpc.config.solver import Solver
from diffdrive_mpc.mpc.qp.backend import MOST_WORKSPACES, Answer, Task
from diffdrive_mpc.mpc.qp.limit_rows import HARD_KINDS
from diffdrive_mpc.mpc.quadratic_program import Kinds, LeastDistance
from diffdrive_mpc.mpc.solver_report import SolverReport, SolverStatus

_STATUS = {
    2: SolverStatus.SOLVED,  # with a soft limit exceeded
    1: SolverStatus.SOLVED,
    -1: SolverStatus.INFEASIBLE,
    -2: SolverStatus.MAX_ITERATIONS,  # it cycles: no more progress
    -3: SolverStatus.UNBOUNDED,
    -4: SolverStatus.MAX_ITERATIONS,
    -5: SolverStatus.NOT_CONVEX,
    -7: SolverStatus.TIME_LIMIT,
}
_DEPENDENT = -6


class DaqpBackend:
    """A work space for each of the sets of limits that mattered lately; implements `mpc.qp.backend.Backend`."""

    def __init__(self, steps: int, settings: Solver, weights: Weights) -> None:
        self._workspace = lru_cache(MOST_WORKSPACES)(partial(_Workspace, steps, settings, weights))

    def solve(self, task: Task) -> Answer:
        """See `mpc.qp.backend.Backend`; the plan that is guessed has no part in it."""
        return self._workspace(task.kinds).solve(task)


class _Workspace:
    """One DAQP model of fixed size, with the rows of some kinds of limit."""

    def __init__(self, steps: int, settings: Solver, weights: Weights, kinds: Kinds) -> None:
        self._steps, self._kinds, self._weights = steps, kinds, weights
        self._soft, self._price = any(kind >= HARD_KINDS for kind in kinds), weights.soft
        self._settings = {"primal_tol": settings.tolerance, "iter_limit": settings.max_iterations}
        if settings.time_limit is not None:
            self._settings["time_limit"] = settings.time_limit
        self._model, self._ready = daqp.Model(), False

    def solve(self, task: Task) -> Answer:
        """Solve for the kinds of this work space."""
        problem = task.qp.least_distance(task.relaxed, self._kinds)
        z, flag, info = self._run(problem, task.multipliers)
        if flag == _DEPENDENT:
            z, flag, info = self._run(problem, np.zeros_like(task.multipliers))
        status = _STATUS.get(flag, SolverStatus.NOT_RUN)
        if z is None:
            return Answer(task.guess, SolverReport(status, soft_limits=self._soft), task.multipliers, ())
        plan, excess, residual, multipliers, kinds = problem.found(z, info["lam"])
        return Answer(plan, SolverReport(status, info["iterations"], excess, residual, self._soft), multipliers, kinds)

    def _run(self, problem: LeastDistance, near: FloatArray) -> tuple[FloatArray | None, int, dict[str, Any]]:
        """Solve from the multipliers `near`; without z where DAQP refuses the numbers."""
        flag = self._load(problem, problem.flags(near, self._price))
        if flag < 0:
            return None, flag, {}
        z, _, flag, info = self._model.solve()
        return z, flag, info

    def _load(self, problem: LeastDistance, sense: NDArray[np.intc]) -> int:
        """Give DAQP the numbers; returns a negative flag where it refuses them."""
        if self._ready:
            flag = self._model.update(A=problem.rows, bupper=problem.upper, blower=problem.lower, sense=sense)
            self._ready = flag >= 0
            return int(flag)
        n, rows = 2 * self._steps, len(sense)
        self._model = daqp.Model()
        flag, _ = self._model.setup(np.eye(n), np.zeros(n), problem.rows, problem.upper, problem.lower, sense)
        self._ready = flag >= 0
        self._model.settings = self._settings
        if self._soft and self._ready:
            looseness, price = np.full(rows, 1 / self._weights.soft_quadratic), np.full(rows, self._price)
            self._model.soft_weights(looseness, looseness, price, price)
        return int(flag)
