"""Solve the condensed problem exactly with as few limits as matter.

Most ticks lean on no limit at all. So the minimiser without limits comes first: where it keeps them all it solves the
whole problem (its multipliers are zero), and no iteration is needed. Else a backend solves with the hard limits and the
soft ones that mattered at the last tick. If that solution keeps all other soft limits it solves the whole problem too;
if not, the kinds of limit that it breaks are added and it is solved again.
"""

from __future__ import annotations

import numpy as np

from models.interface import FloatArray
from mpc.condensed import QuadraticProgram
from mpc.config import Solver, Weights
from mpc.qp.daqp_workspace import DaqpWorkspace
from mpc.qp.hard_rows import HardRows
from mpc.qp.multipliers import Multipliers
from mpc.qp.osqp_workspace import OsqpWorkspace
from mpc.qp.relaxed import Relaxed, relax
from mpc.qp.solution import Solution
from mpc.qp.workspace import Kinds, Workspace
from mpc.solver_report import SolverReport, SolverStatus

_BACKENDS: dict[str, type[Workspace]] = {"osqp": OsqpWorkspace, "daqp": DaqpWorkspace}

# A soft limit exceeded by less than this counts as kept: it is the size of the solvers' own residuals.
_SOFT_SLACK = 1e-6

# Numbers beyond this are no robot's, and OSQP takes bounds beyond 1e30 for none.
_LARGEST = 1e15


class CondensedSolver:
    """A backend's work spaces, one for each set of soft limits that has mattered so far.

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
        self._hard = HardRows(steps)
        self._nothing = Multipliers.none(steps)
        self.reset()

    def reset(self) -> None:
        """Forget every earlier solve; called after a failure, so that no bad iterate is carried on."""
        self._workspaces: dict[Kinds, Workspace] = {}
        self._multipliers = self._nothing

    def solve(self, qp: QuadraticProgram, guess: FloatArray) -> Solution:
        """Solve, starting from the plan `guess` (N, 2). Never raises on numbers: see the report's status."""
        if not all(_is_sound(data) for data in (qp.H, qp.g, qp.box, qp.last_command, qp.soft_upper)):
            return Solution(guess, SolverReport(SolverStatus.NOT_FINITE))
        relaxed = relax(qp)
        if relaxed is None:
            return Solution(guess, SolverReport(SolverStatus.NOT_CONVEX))
        self._hard.load(qp)
        plan = relaxed.plan
        if self._hard.keeps(self._hard.values(plan)) and not _exceeded(qp, plan, 0.0):
            self._multipliers = self._nothing
            residual = float(np.abs(qp.H @ plan + qp.g).max())
            report = SolverReport(SolverStatus.SOLVED, 0, primal_residual=0.0, dual_residual=residual)
            return Solution(plan.reshape(-1, 2), report)
        start = self._nothing if self._multipliers is self._nothing else self._multipliers.shifted()
        return self._lean(qp, relaxed, guess.ravel(), start)

    def _lean(self, qp: QuadraticProgram, relaxed: Relaxed, guess: FloatArray, start: Multipliers) -> Solution:
        """Solve where limits matter."""
        iterations, kinds = 0, start.kinds
        while True:
            workspace = self._workspaces.get(kinds)
            if workspace is None:
                backend = _BACKENDS[self._settings.backend]
                workspace = self._workspaces[kinds] = backend(self._steps, self._settings, self._weights, kinds)
            plan, report, found = workspace.solve(qp, relaxed, self._hard, guess, start)
            iterations += report.iterations
            missed = _exceeded(qp, plan, _SOFT_SLACK) - set(kinds) if report.status.usable else set()
            if not missed:
                break
            kinds, start = tuple(sorted({*kinds, *missed})), found
        self._multipliers = found if report.status.usable else self._nothing
        return Solution(plan.reshape(-1, 2), report.after(iterations))


def _is_sound(data: FloatArray) -> bool:
    """Whether no number is NaN, infinite or larger than any robot's; one pass, without a temporary."""
    flat = data.reshape(-1)
    return bool(flat @ flat < _LARGEST**2)


def _exceeded(qp: QuadraticProgram, plan: FloatArray, slack: float) -> set[int]:
    """Kinds of soft limit that the flat `plan` breaks somewhere by more than `slack`."""
    kinds, steps, n = qp.soft.shape
    rows = (qp.soft.reshape(-1, n) @ plan).reshape(kinds, steps)
    over = np.maximum(rows - qp.soft_upper, qp.soft_lower - rows)
    if over.max() <= slack:
        return set()
    return set(np.flatnonzero(over.max(axis=1) > slack).tolist())
