"""Solve with DAQP, a dual active-set method, as a least-distance problem.

DAQP has nothing to factorise then. It begins from the limits that are taken to be active. Soft limits are its own: an
exact and a quadratic price on each row, without slack variables.
"""

from __future__ import annotations

from typing import Any

import daqp
import numpy as np
from numpy.typing import NDArray

from models.interface import FloatArray
from mpc.config import Solver, Weights
from mpc.qp.backend import Answer, Task
from mpc.qp.limit_rows import HARD_KINDS
from mpc.quadratic_program import Kinds, LeastDistance
from mpc.solver_report import SolverReport, SolverStatus

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
    """A work space for each set of limits that has mattered so far; implements `mpc.qp.backend.Backend`."""

    def __init__(self, steps: int, settings: Solver, weights: Weights) -> None:
        self._steps, self._settings, self._weights = steps, settings, weights
        self._workspaces: dict[Kinds, _Workspace] = {}

    def solve(self, task: Task) -> Answer:
        """See `mpc.qp.backend.Backend`; the plan that is guessed has no part in it."""
        workspace = self._workspaces.get(task.kinds)
        if workspace is None:
            workspace = _Workspace(self._steps, self._settings, self._weights, task.kinds)
            self._workspaces[task.kinds] = workspace
        return workspace.solve(task)


class _Workspace:
    """One DAQP model of fixed size, with the rows of some kinds of limit."""

    def __init__(self, steps: int, settings: Solver, weights: Weights, kinds: Kinds) -> None:
        self._steps, self._kinds, self._weights = steps, kinds, weights
        self._soft, self._price = any(kind >= HARD_KINDS for kind in kinds), weights.soft
        self._settings = {"primal_tol": settings.tolerance, "iter_limit": settings.max_iterations}
        if settings.time_limit is not None:
            self._settings["time_limit"] = settings.time_limit
        self._model: daqp.Model | None = None

    def solve(self, task: Task) -> Answer:
        """Solve for the kinds of this work space."""
        problem = task.qp.least_distance(task.relaxed, self._kinds)
        z, _, flag, info = self._run(problem, problem.flags(task.multipliers, self._price))
        if flag == _DEPENDENT:
            z, _, flag, info = self._run(problem, problem.flags(np.zeros_like(task.multipliers), self._price))
        plan, excess, residual, multipliers, kinds = problem.found(z, info["lam"])
        status = _STATUS.get(flag, SolverStatus.NOT_RUN)
        return Answer(plan, SolverReport(status, info["iterations"], excess, residual, self._soft), multipliers, kinds)

    def _run(self, problem: LeastDistance, sense: NDArray[np.intc]) -> tuple[FloatArray, float, int, dict[str, Any]]:
        if self._model is None:
            self._model, n = daqp.Model(), 2 * self._steps
            self._model.setup(np.eye(n), np.zeros(n), problem.rows, problem.upper, problem.lower, sense)
            self._model.settings = self._settings
            if self._soft:
                rows = len(sense)
                looseness, price = np.full(rows, 1 / self._weights.soft_quadratic), np.full(rows, self._price)
                self._model.soft_weights(looseness, looseness, price, price)
        else:
            self._model.update(A=problem.rows, bupper=problem.upper, blower=problem.lower, sense=sense)
        return self._model.solve()  # type: ignore[no-any-return]
