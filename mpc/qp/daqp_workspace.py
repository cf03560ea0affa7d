"""Solve with DAQP, a dual active-set method, as a least-distance problem.

With H = L L' and U = U0 + z / L', U0 the minimiser without limits, the cost is |z|^2 / 2: DAQP has nothing to factorise,
and begins from the limits that were active at the last tick, one step ahead. Soft limits are its own: an exact and a
quadratic price on each row, without slack variables.
"""

from __future__ import annotations

import daqp
import numpy as np
from numpy.typing import NDArray

from models.interface import FloatArray
from mpc.condensed import QuadraticProgram
from mpc.config import Solver, Weights
from mpc.qp.hard_rows import HardRows
from mpc.qp.multipliers import Multipliers
from mpc.qp.relaxed import Relaxed, inverse_factor
from mpc.qp.workspace import Kinds
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
_ACTIVE, _LOWER, _SOFT = 1, 2, 8


class DaqpWorkspace:
    """One DAQP model of fixed size; implements `mpc.qp.workspace.Workspace`."""

    def __init__(self, steps: int, settings: Solver, weights: Weights, kinds: Kinds) -> None:
        self._n = n = 2 * steps
        self._steps, self._kinds, self._weights = steps, list(kinds), weights
        rows = 2 * n + len(kinds) * steps
        self._cost, self._linear = np.eye(n), np.zeros(n)
        self._rows = np.empty((rows, n))
        self._upper, self._lower = np.empty(rows), np.empty(rows)
        self._cold = np.zeros(rows, dtype=np.intc)
        self._cold[2 * n :] = _SOFT
        self._settings = {"primal_tol": settings.tolerance, "iter_limit": settings.max_iterations}
        if settings.time_limit is not None:
            self._settings["time_limit"] = settings.time_limit
        self._model: daqp.Model | None = None

    def solve(
        self, qp: QuadraticProgram, relaxed: Relaxed, hard: HardRows, guess: FloatArray, start: Multipliers
    ) -> tuple[FloatArray, SolverReport, Multipliers]:
        """See `mpc.qp.workspace.Workspace`; `guess` has no part in it, the active set of `start` has."""
        inverse = self._load(qp, relaxed, hard)
        z, _, flag, info = self._run(self._active(start))
        if flag == _DEPENDENT:
            z, _, flag, info = self._run(self._cold)
        pressing = info["lam"]
        report = SolverReport(
            status=_STATUS.get(flag, SolverStatus.NOT_RUN),
            iterations=int(info["iterations"]),
            primal_residual=self._excess(z),
            dual_residual=float(np.abs(z + pressing @ self._rows).max()),
            soft_limits=bool(self._kinds),
        )
        return relaxed.plan + inverse @ z, report, self._multipliers(pressing)

    def _load(self, qp: QuadraticProgram, relaxed: Relaxed, hard: HardRows) -> FloatArray:
        """Write rows and bounds for z; returns the map from z to the commands."""
        n = self._n
        inverse = inverse_factor(relaxed.factor)
        rows, now = self._rows, hard.values(relaxed.plan)
        rows[:n] = inverse
        rows[n : n + 2] = inverse[:2]
        np.subtract(inverse[2:], inverse[:-2], out=rows[n + 2 : 2 * n])
        np.subtract(hard.limit, now, out=self._upper[: 2 * n])
        np.subtract(-hard.limit, now, out=self._lower[: 2 * n])
        for place, kind in enumerate(self._kinds, start=4):
            part = slice(place * self._steps, (place + 1) * self._steps)
            np.matmul(qp.soft[kind], inverse, out=rows[part])
            now = qp.soft[kind] @ relaxed.plan
            self._upper[part], self._lower[part] = qp.soft_upper[kind] - now, qp.soft_lower[kind] - now
        return inverse

    def _run(self, sense: NDArray[np.intc]) -> tuple[FloatArray, float, int, dict[str, FloatArray]]:
        if self._model is None:
            self._model = daqp.Model()
            self._model.setup(self._cost, self._linear, self._rows, self._upper, self._lower, sense)
            self._model.settings = self._settings
            if self._kinds:
                price = np.full(len(sense), self._weights.soft)
                looseness = np.full(len(sense), 1 / self._weights.soft_quadratic)
                self._model.soft_weights(looseness, looseness, price, price)
        else:
            self._model.update(A=self._rows, bupper=self._upper, blower=self._lower, sense=sense)
        return self._model.solve()  # type: ignore[no-any-return]

    def _active(self, start: Multipliers) -> NDArray[np.intc]:
        """DAQP's flags of the rows: those that press in `start` are taken to be active."""
        pressing = np.concatenate([start.hard.reshape(-1), start.soft[self._kinds].reshape(-1)])
        sense = self._cold.copy()
        sense[pressing > 0] |= _ACTIVE
        sense[pressing < 0] |= _ACTIVE | _LOWER
        return sense

    def _multipliers(self, pressing: FloatArray) -> Multipliers:
        found = Multipliers.none(self._steps)
        found.hard.reshape(-1)[:] = pressing[: 2 * self._n]
        found.soft[self._kinds] = pressing[2 * self._n :].reshape(-1, self._steps)
        return found

    def _excess(self, z: FloatArray) -> float:
        """By how much the worst hard limit is exceeded."""
        hard = slice(0, 2 * self._n)
        values = self._rows[hard] @ z
        return max(0.0, float(np.maximum(values - self._upper[hard], self._lower[hard] - values).max()))
