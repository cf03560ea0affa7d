"""The sparse problem in OSQP, for some kinds of soft limits."""

from __future__ import annotations

import numpy as np
import osqp

from models.interface import FloatArray
from mpc.problem import TrackingProblem
from mpc.qp.limit_rows import HARD_KINDS
from mpc.qp.osqp_status import OSQP_STATUS
from mpc.quadratic_program import Kinds
from mpc.solver_report import SolverReport, SolverStatus
from mpc.sparse.constraints import Constraints
from mpc.sparse.cost import Cost
from mpc.sparse.layout import Layout
from mpc.sparse.linearised import Linearised


class SparseWorkspace:
    """One OSQP instance of fixed sparsity with its warm start."""

    def __init__(self, problem: TrackingProblem, soft_kinds: Kinds) -> None:
        self._settings, self._kinds = problem.config.solver, soft_kinds
        self._layout = layout = Layout(problem.steps, problem.model.order, soft_kinds)
        self._cost = Cost(layout, problem)
        self._constraints = Constraints(layout, problem.model, soft_kinds)
        self._solver: osqp.OSQP | None = None
        self._start = np.zeros(layout.columns)
        self._dual = np.zeros(layout.rows)

    def solve(self, at: Linearised, guess: FloatArray) -> tuple[FloatArray, FloatArray, SolverReport]:
        """Solve, starting from the plan `guess` (N, 2) along which `at` was linearised.

        Returns
        -------
        tuple
            The plan (N, 2), the values (5, N) of all soft rows, and the report.
        """
        cost, constraints, layout, soft = self._cost, self._constraints, self._layout, bool(self._kinds)
        cost.load(at)
        constraints.load(at)
        data = {"q": cost.gradient, "l": constraints.lower, "u": constraints.upper}
        try:
            if self._solver is None:
                self._solver = self._set_up()
            else:
                self._solver.update(Px=cost.matrix.data, Ax=constraints.matrix.data, **data)
        except (osqp.OSQPException, ValueError):
            return guess, np.zeros_like(at.soft_upper), SolverReport(SolverStatus.REFUSED, soft_limits=soft)
        self._start[layout.commands], self._start[layout.twists] = guess, at.twists
        self._solver.warm_start(x=self._start, y=self._dual[layout.ahead])
        result = self._solver.solve(raise_error=False)
        report = SolverReport(
            status=OSQP_STATUS.get(result.info.status_val, SolverStatus.NOT_RUN),
            iterations=int(result.info.iter),
            primal_residual=float(result.info.prim_res),
            dual_residual=float(result.info.dual_res),
            soft_limits=soft,
        )
        z = np.array(result.x)
        if report.status.usable:
            # The states go on from where they were; commands, twists and poses are those of the next guess.
            self._start[layout.states] = z[layout.states]
            self._dual = np.array(result.y)
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

    def _set_up(self) -> osqp.OSQP:
        solver, settings = osqp.OSQP(), self._settings
        solver.setup(
            self._cost.matrix,
            self._cost.gradient,
            self._constraints.matrix,
            self._constraints.lower,
            self._constraints.upper,
            verbose=False,
            eps_abs=settings.tolerance,
            eps_rel=settings.tolerance,
            max_iter=settings.max_iterations,
            check_termination=settings.check_every,
            # By iterations, not by time: a run must not depend on how fast the machine is.
            adaptive_rho=1,
            adaptive_rho_interval=50,
            polishing=False,
            **({} if settings.time_limit is None else {"time_limit": settings.time_limit}),
        )
        return solver


def soft_kinds_broken(values: FloatArray, at: Linearised, slack: float) -> set[int]:
    """Kinds of soft limit (numbered among all kinds) that `values` (5, N) break somewhere by more than `slack`."""
    excess = np.maximum(values - at.soft_upper, at.soft_lower - values)
    return set((np.flatnonzero(excess.max(axis=1) > slack) + HARD_KINDS).tolist())
