"""Solve the condensed problem exactly with as few limits as matter.

Most ticks lean on no limit at all. So the minimiser without limits comes first: where it keeps them all it solves the
whole problem (its multipliers are zero), and no iteration is needed. Else a backend solves with the kinds of limit that
mattered at the last tick or that this minimiser breaks. If its solution keeps all others it solves the whole problem
too; if not, the kinds that it breaks are added and it is solved again.
"""

from __future__ import annotations

import numpy as np

from models.interface import FloatArray
from mpc.config import Solver, Weights
from mpc.qp.backend import Backend, Task
from mpc.qp.daqp_backend import DaqpBackend
from mpc.qp.limit_rows import KINDS, Kinds, LimitRows, broken
from mpc.qp.osqp_backend import OsqpBackend
from mpc.qp.relaxed import Relaxed, relax
from mpc.qp.solution import Solution
from mpc.quadratic_program import QuadraticProgram
from mpc.solver_report import SolverReport, SolverStatus

_BACKENDS: dict[str, type[Backend]] = {"osqp": OsqpBackend, "daqp": DaqpBackend}

# Numbers beyond this are no robot's, and OSQP takes bounds beyond 1e30 for none.
_LARGEST = 1e15


class CondensedSolver:
    """Minimiser without limits, backend, and the limits that mattered last.

    Parameters
    ----------
    steps
        Horizon N.
    settings
        Backend, tolerance, limits of iterations and time.
    weights
        Prices of exceeding soft limits.
    """

    def __init__(self, steps: int, settings: Solver, weights: Weights) -> None:
        self._steps, self._settings, self._weights = steps, settings, weights
        # Below the solvers' own residuals a limit counts as kept.
        self._slack = 0.1 * settings.tolerance
        self._rows = LimitRows(steps)
        self._nothing = np.zeros((KINDS, steps))
        self.reset()

    def reset(self) -> None:
        """Forget every earlier solve; called after a failure, so that no bad iterate is carried on."""
        self._backend = _BACKENDS[self._settings.backend](self._steps, self._settings, self._weights)
        self._multipliers = self._nothing

    def solve(self, qp: QuadraticProgram, guess: FloatArray) -> Solution:
        """Solve, starting from the plan `guess` (N, 2). Never raises on numbers: see the report's status."""
        if not all(_is_sound(data) for data in (qp.H, qp.g, qp.box, qp.last_command, qp.soft_upper)):
            return Solution(guess, SolverReport(SolverStatus.NOT_FINITE))
        relaxed = relax(qp)
        if relaxed is None:
            return Solution(guess, SolverReport(SolverStatus.NOT_CONVEX))
        plan, rows = relaxed.plan, self._rows
        rows.load(qp)
        missed = broken(rows.excess(rows.values(plan)), 0.0)
        if missed:
            return self._lean(qp, relaxed, missed, guess.ravel())
        self._multipliers = self._nothing
        residual = float(np.abs(qp.H @ plan + qp.g).max())
        return Solution(plan.reshape(-1, 2), SolverReport(SolverStatus.SOLVED, 0, 0.0, residual))

    def _lean(self, qp: QuadraticProgram, relaxed: Relaxed, missed: Kinds, guess: FloatArray) -> Solution:
        """Solve where limits matter, `missed` among them."""
        iterations, start = 0, self._nothing
        if self._multipliers is not self._nothing:
            start = np.concatenate((self._multipliers[:, 1:], self._multipliers[:, -1:]), axis=1)
        kinds: Kinds = tuple(np.flatnonzero(start.any(axis=1)).tolist()) or missed
        while True:
            answer = self._backend.solve(Task(qp, self._rows, relaxed, kinds, guess, start))
            iterations, start = iterations + answer.report.iterations, answer.multipliers
            if not answer.report.status.usable:
                self._multipliers = self._nothing
                break
            self._multipliers = start
            missed = broken(self._rows.excess(self._rows.values(answer.plan)), self._slack)
            if set(missed) <= set(kinds):
                break
            kinds = tuple(sorted({*kinds, *missed}))
        return Solution(answer.plan.reshape(-1, 2), answer.report.after(iterations))


def _is_sound(data: FloatArray) -> bool:
    """Whether no number is NaN, infinite or larger than any robot's; one pass, without a temporary."""
    flat = data.reshape(-1)
    return bool(flat @ flat < _LARGEST**2)
