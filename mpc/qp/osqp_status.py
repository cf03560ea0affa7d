"""OSQP's statuses in our words."""

from __future__ import annotations

import osqp

from mpc.solver_report import SolverStatus

OSQP_STATUS = {
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
