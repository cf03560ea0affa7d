"""The sparse way through the problem."""

from __future__ import annotations

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.mpc.problem import TrackingProblem
from diffdrive_mpc.mpc.qp.solution import Solution
from diffdrive_mpc.mpc.quadratic_program import Kinds
from diffdrive_mpc.mpc.solver_report import SolverReport, SolverStatus
from diffdrive_mpc.mpc.sparse.linearised import Lineariser
from diffdrive_mpc.mpc.sparse.workspace import SparseWorkspace, soft_kinds_broken
from diffdrive_mpc.mpc.tick import Tick

# Numbers beyond this are no robot's, and OSQP takes bounds beyond 1e30 for none.
_LARGEST = 1e15


class SparseSolver:
    """States, twists, poses and commands are variables, the dynamics are equations; OSQP solves.

    As in the condensed way, soft limits join in only when they are broken, and leave when they do not press.
    """

    def __init__(self, problem: TrackingProblem) -> None:
        self._problem = problem
        self._lineariser = Lineariser(problem)
        self._slack = 0.1 * problem.config.solver.tolerance
        self.reset()

    def reset(self) -> None:
        """Forget every earlier solve; called after a failure, so that no bad iterate is carried on."""
        self._workspaces: dict[Kinds, SparseWorkspace] = {}
        self._kinds: Kinds = ()

    def solve(self, tick: Tick, guess: FloatArray) -> Solution:
        """Linearise along the plan `guess` (N, 2) and solve. Never raises on numbers: see the report's status."""
        at = self._lineariser.linearise(tick, guess)
        data = (at.twists, at.moves, at.error, at.box, at.last_command, at.feed_forward, at.soft_upper)
        # Squares add up to one number; NaN fails the comparison.
        if not all(np.vdot(part, part) < _LARGEST**2 for part in data):
            return Solution(guess, SolverReport(SolverStatus.NOT_FINITE))
        iterations, kinds = 0, self._kinds
        while True:
            if kinds not in self._workspaces:
                self._workspaces[kinds] = SparseWorkspace(self._problem, kinds)
            workspace = self._workspaces[kinds]
            plan, values, report = workspace.solve(at, guess)
            iterations += report.iterations
            missed = soft_kinds_broken(values, at, self._slack) - set(kinds)
            if not report.status.usable or not missed:
                break
            kinds = tuple(sorted({*kinds, *missed}))
        self._kinds = workspace.active_kinds if report.status.usable else ()
        return Solution(plan, report.after(iterations))
