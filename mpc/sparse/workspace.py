"""The sparse problem in OSQP, for some kinds of soft limits."""

from __future__ import annotations

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.mpc.problem import TrackingProblem
from diffdrive_mpc.mpc.qp.limit_rows import HARD_KINDS
from diffdrive_mpc.mpc.qp.osqp_instance import OsqpInstance
from diffdrive_mpc.mpc.quadratic_program import Kinds
from diffdrive_mpc.mpc.solver_report import SolverReport, SolverStatus
from diffdrive_mpc.mpc.sparse.constraints import Constraints
from diffdrive_mpc.mpc.sparse.cost import Cost
from diffdrive_mpc.mpc.sparse.layout import Layout
from diffdrive_mpc.mpc.sparse.linearised import Linearised


class SparseWorkspace:
    """One OSQP instance of fixed sparsity with its warm start."""

    def __init__(self, problem: TrackingProblem, soft_kinds: Kinds) -> None:
        self._settings, self._kinds = problem.config.solver, soft_kinds
        self._layout = layout = Layout(problem.steps, problem.model.order, soft_kinds)
        self._cost = Cost(layout, problem)
        self._constraints = Constraints(layout, problem.model, soft_kinds)
        self._osqp = OsqpInstance(
            self._cost.matrix,
            self._constraints.matrix,
            self._settings,
            soft_limits=bool(soft_kinds),
            rows_change=True,
        )
        self._start = np.zeros(layout.columns)
        self._dual = np.zeros(layout.rows)

    def solve(self, at: Linearised, guess: FloatArray) -> tuple[FloatArray, FloatArray, SolverReport]:
        """Solve, starting from the plan `guess` (N, 2) along which `at` was linearised.

        Returns
        -------
        tuple
            The plan (N, 2), the values (5, N) of all soft rows, and the report.
        """
        cost, constraints, layout = self._cost, self._constraints, self._layout
        cost.load(at)
        constraints.load(at)
        self._start[layout.commands], self._start[layout.twists] = guess, at.twists
        z, dual, report = self._osqp.solve(
            cost.gradient, constraints.lower, constraints.upper, self._start, self._dual[layout.ahead]
        )
        if report.status is SolverStatus.REFUSED:
            return guess, np.zeros_like(at.soft_upper), report
        if report.status.usable:
            # The states go on from where they were; commands, twists and poses are those of the next guess.
            self._start[layout.states] = z[layout.states]
            self._dual = dual
        values = np.empty_like(at.soft_upper)
        values[:-1] = at.soft_rows @ z[layout.twists].T
        dx, dy, _ = z[layout.poses].T
        values[-1] = at.direction[:, 0] * dy - at.direction[:, 1] * dx
        return z[layout.commands], values, report

    @property
    def active_kinds(self) -> Kinds:
        """The kinds of soft limit that the last solution leaned on."""
        pressing = np.abs(self._dual[self._layout.soft_rows]).max(axis=1, initial=0.0)
        return tuple(kind for kind, most in zip(self._kinds, pressing, strict=True) if most > self._settings.tolerance)


def soft_kinds_broken(values: FloatArray, at: Linearised, slack: float) -> set[int]:
    """Kinds of soft limit (numbered among all kinds) that `values` (5, N) break somewhere by more than `slack`."""
    excess = np.maximum(values - at.soft_upper, at.soft_lower - values)
    return set((np.flatnonzero(excess.max(axis=1) > slack) + HARD_KINDS).tolist())
