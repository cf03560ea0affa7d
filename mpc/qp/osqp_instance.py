"""One problem of fixed sparsity in OSQP, and what OSQP says of it in our words."""

from __future__ import annotations

import numpy as np
import osqp
from scipy import sparse

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.mpc.config.solver import Solver
from diffdrive_mpc.mpc.solver_report import SolverReport, SolverStatus

_STATUS = {
    osqp.SolverStatus.OSQP_SOLVED: SolverStatus.SOLVED,
    osqp.SolverStatus.OSQP_SOLVED_INACCURATE: SolverStatus.SOLVED_INACCURATELY,
    osqp.SolverStatus.OSQP_MAX_ITER_REACHED: SolverStatus.MAX_ITERATIONS,
    osqp.SolverStatus.OSQP_TIME_LIMIT_REACHED: SolverStatus.TIME_LIMIT,
    osqp.SolverStatus.OSQP_PRIMAL_INFEASIBLE: SolverStatus.INFEASIBLE,
    osqp.SolverStatus.OSQP_PRIMAL_INFEASIBLE_INACCURATE: SolverStatus.INFEASIBLE,
    osqp.SolverStatus.OSQP_DUAL_INFEASIBLE: SolverStatus.UNBOUNDED,
    osqp.SolverStatus.OSQP_DUAL_INFEASIBLE_INACCURATE: SolverStatus.UNBOUNDED,
    osqp.SolverStatus.OSQP_NON_CVX: SolverStatus.NOT_CONVEX,
}


class OsqpInstance:
    """Set up at the first solve, with new numbers at each of them.

    Parameters
    ----------
    P, A
        Cost (upper triangle) and rows; their stored values may change between solves, their places may not.
    settings
        Tolerance, limits of iterations and time.
    soft_limits
        Whether some of the rows are soft limits; for the report.
    rows_change
        Whether the values of `A` change.
    """

    def __init__(
        self, P: sparse.csc_matrix, A: sparse.csc_matrix, settings: Solver, *, soft_limits: bool, rows_change: bool
    ) -> None:
        self._P, self._A, self._settings = P, A, settings
        self._soft_limits, self._rows_change = soft_limits, rows_change
        self._solver: osqp.OSQP | None = None

    def solve(
        self, q: FloatArray, lower: FloatArray, upper: FloatArray, x: FloatArray, y: FloatArray
    ) -> tuple[FloatArray, FloatArray, SolverReport]:
        """Minimise x'Px/2 + q'x subject to lower <= Ax <= upper from `x` and its multipliers `y`; returns new ones."""
        try:
            if self._solver is None:
                self._solver = self._set_up(q, lower, upper)
            else:
                changed = {"Ax": self._A.data} if self._rows_change else {}
                self._solver.update(q=q, l=lower, u=upper, Px=self._P.data, **changed)
        except (osqp.OSQPException, ValueError):
            return x, y, SolverReport(SolverStatus.REFUSED, soft_limits=self._soft_limits)
        self._solver.warm_start(x=x, y=y)
        result = self._solver.solve(raise_error=False)
        report = SolverReport(
            status=_STATUS.get(result.info.status_val, SolverStatus.NOT_RUN),
            iterations=int(result.info.iter),
            primal_residual=float(result.info.prim_res),
            dual_residual=float(result.info.dual_res),
            soft_limits=self._soft_limits,
        )
        return np.array(result.x), np.array(result.y), report

    def _set_up(self, q: FloatArray, lower: FloatArray, upper: FloatArray) -> osqp.OSQP:
        solver, settings = osqp.OSQP(), self._settings
        solver.setup(
            self._P,
            q,
            self._A,
            lower,
            upper,
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
