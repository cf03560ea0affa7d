"""Solve with DAQP, a dual active-set method, as a least-distance problem.

With H = L L' and U = U0 + z / L', U0 the minimiser without limits, the cost is |z|^2 / 2: nothing is left to factorise.
It begins from the limits that are taken to be active. Soft limits are DAQP's own: an exact and a quadratic price on
each row, without slack variables.
"""

from __future__ import annotations

import daqp
import numpy as np
from numpy.typing import NDArray

from models.interface import FloatArray
from mpc.config import Solver, Weights
from mpc.qp.backend import Answer, Task
from mpc.qp.limit_rows import HARD_KINDS
from mpc.qp.relaxed import inverse_factor
from mpc.quadratic_program import Kinds, QuadraticProgram
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
# DAQP's flags of a row; the last says of a soft limit that it is kept, though it presses.
_ACTIVE, _LOWER, _SOFT, _KEPT = 1, 2, 8, 32


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
        self._steps, self._kinds, self._chosen = steps, kinds, np.array(kinds, dtype=np.intp)
        self._hard = sum(kind < HARD_KINDS for kind in kinds)
        count = steps * len(kinds)
        # By kind; DAQP sees them all below one another.
        self._rows = np.empty((len(kinds), steps, 2 * steps))
        self._stack = self._rows.reshape(count, 2 * steps)
        self._cold = np.zeros(count, dtype=np.intc)
        self._cold[self._hard * steps :] = _SOFT
        self._settings = {"primal_tol": settings.tolerance, "iter_limit": settings.max_iterations}
        if settings.time_limit is not None:
            self._settings["time_limit"] = settings.time_limit
        self._price, self._looseness = np.zeros(count), np.full(count, 1 / weights.soft_quadratic)
        self._price[self._hard * steps :] = weights.soft
        self._model: daqp.Model | None = None

    def solve(self, task: Task) -> Answer:
        """Solve for the kinds of this work space."""
        inverse = inverse_factor(task.relaxed.factor)
        self._load(inverse, task.qp)
        chosen = self._chosen
        now = task.values[chosen]
        upper, lower = (task.rows.upper[chosen] - now).reshape(-1), (task.rows.lower[chosen] - now).reshape(-1)
        sense = self._flags(task.multipliers[chosen].reshape(-1))
        z, _, flag, info = self._run(upper, lower, sense)
        if flag == _DEPENDENT:
            z, _, flag, info = self._run(upper, lower, self._cold)
        pressing, hard = info["lam"], self._hard * self._steps
        values = self._stack @ z
        excess = np.maximum(values - upper, lower - values)[:hard]
        report = SolverReport(
            status=_STATUS.get(flag, SolverStatus.NOT_RUN),
            iterations=int(info["iterations"]),
            primal_residual=max(0.0, float(excess.max(initial=0.0))),
            dual_residual=float(np.abs(z + pressing @ self._stack).max()),
            soft_limits=len(self._kinds) > self._hard,
        )
        multipliers = np.zeros_like(task.multipliers)
        multipliers[chosen] = pressing.reshape(-1, self._steps)
        return Answer(task.relaxed.plan + inverse @ z, report, multipliers)

    def _flags(self, pressing: FloatArray) -> NDArray[np.intc]:
        """The rows that press are taken to be active."""
        sense = self._cold.copy()
        sense[pressing > 0] += _ACTIVE
        sense[pressing < 0] += _ACTIVE + _LOWER
        if len(self._kinds) > self._hard:
            sense[(pressing != 0) & (np.abs(pressing) < self._price)] += _KEPT
        return sense

    def _load(self, inverse: FloatArray, qp: QuadraticProgram) -> None:
        """Write the rows as functions of z."""
        for rows, kind in zip(self._rows, self._kinds, strict=True):
            own = inverse[kind % 2 :: 2]
            if kind < 2:
                rows[:] = own
            elif kind < HARD_KINDS:
                rows[0] = own[0]
                np.subtract(own[1:], own[:-1], out=rows[1:])
            else:
                np.matmul(qp.soft_rows(kind - HARD_KINDS), inverse, out=rows)

    def _run(
        self, upper: FloatArray, lower: FloatArray, sense: NDArray[np.intc]
    ) -> tuple[FloatArray, float, int, dict[str, FloatArray]]:
        if self._model is None:
            self._model, n = daqp.Model(), 2 * self._steps
            self._model.setup(np.eye(n), np.zeros(n), self._stack, upper, lower, sense)
            self._model.settings = self._settings
            if len(self._kinds) > self._hard:
                self._model.soft_weights(self._looseness, self._looseness, self._price, self._price)
        else:
            self._model.update(A=self._stack, bupper=upper, blower=lower, sense=sense)
        return self._model.solve()  # type: ignore[no-any-return]
