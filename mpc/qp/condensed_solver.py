"""Solve the condensed problem exactly with as few limits as matter.

Most ticks lean on no limit at all. So the minimiser without limits comes first: where it keeps them all it solves the
whole problem (its multipliers are zero), and no iteration is needed. Else a backend solves with the kinds of limit that
mattered at the last tick or that this minimiser breaks. If its solution keeps all others it solves the whole problem
too; if not, the kinds that it breaks are added and it is solved again. OSQP, which begins without a set of limits, is
asked only where leaning on those of the last tick (`mpc.qp.leaning`) does not prove to be the solution.
"""

from __future__ import annotations

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.mpc.config.schema import Weights
from diffdrive_mpc.mpc.config.solver import Solver
from diffdrive_mpc.mpc.qp.backend import Answer, Backend, Task
from diffdrive_mpc.mpc.qp.daqp_backend import DaqpBackend
from diffdrive_mpc.mpc.qp.leaning import lean_on
from diffdrive_mpc.mpc.qp.limit_rows import HARD_KINDS, KINDS
from diffdrive_mpc.mpc.qp.osqp_backend import OsqpBackend
from diffdrive_mpc.mpc.qp.solution import Solution
from diffdrive_mpc.mpc.quadratic_program import Kinds, QuadraticProgram
from diffdrive_mpc.mpc.solver_report import SolverReport, SolverStatus

_BACKENDS: dict[str, type[Backend]] = {"osqp": OsqpBackend, "daqp": DaqpBackend}


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
        self._nothing = np.zeros((KINDS, steps))
        self.reset()

    def reset(self) -> None:
        """Forget every earlier solve; called after a failure, so that no bad iterate is carried on."""
        self._backend = _BACKENDS[self._settings.backend](self._steps, self._settings, self._weights)
        self._multipliers = self._nothing
        self._kinds: Kinds = ()

    def solve(self, qp: QuadraticProgram, guess: FloatArray) -> Solution:
        """Solve, starting from the plan `guess` (N, 2). Never raises on numbers: see the report's status."""
        relaxed = qp.relax()
        if isinstance(relaxed, SolverStatus):
            return Solution(guess, SolverReport(relaxed))
        missed = relaxed.broken
        if missed:
            return self._lean(Task(qp, relaxed, missed, guess.reshape(-1), self._nothing))
        self._kinds = ()
        report = SolverReport(SolverStatus.SOLVED, 0, 0.0, relaxed.residual)
        return Solution(relaxed.plan.reshape(-1, 2), report)

    def _lean(self, task: Task) -> Solution:
        """Solve where limits matter: begin with those of `task` and those that mattered last."""
        if self._kinds:
            # One step ahead, as the plan.
            task.multipliers = np.concatenate((self._multipliers[:, 1:], self._multipliers[:, -1:]), axis=1)
            task.kinds = _union(task.kinds, self._kinds)
        iterations = 0
        while True:
            answer = self._leaning(task) or self._backend.solve(task)
            iterations += answer.report.iterations
            if not answer.report.status.usable:
                self._kinds = ()
                break
            self._multipliers, self._kinds, task.multipliers = answer.multipliers, answer.kinds, answer.multipliers
            missed = task.qp.broken(answer.plan, self._slack)
            if set(missed) <= set(task.kinds):
                break
            task.kinds = _union(task.kinds, missed)
        return Solution(answer.plan.reshape(-1, 2), answer.report.after(iterations))

    def _leaning(self, task: Task) -> Answer | None:
        """The solution on the limits that pressed last, if it is one; its rounds count as iterations.

        DAQP begins like this by itself, and soft limits that press have a price, which is not looked at here.
        """
        if self._settings.backend != "osqp" or any(kind >= HARD_KINDS for kind in task.kinds):
            return None
        problem = task.qp.least_distance(task.relaxed, task.kinds)
        found = lean_on(problem, task.multipliers[list(task.kinds)].reshape(-1), self._slack)
        if found is None:
            return None
        plan, excess, residual, multipliers, kinds = problem.found(found.z, found.pressing)
        return Answer(plan, SolverReport(SolverStatus.SOLVED, found.rounds, excess, residual), multipliers, kinds)


def _union(some: Kinds, others: Kinds) -> Kinds:
    return some if some == others else tuple(sorted({*some, *others}))
