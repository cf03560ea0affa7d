"""Backend for DAQP, a dual active-set method that is warm-started with a guess of the active limits.

DAQP supports soft limits without slack variables: each soft row has a linear and a quadratic penalty.
"""

from __future__ import annotations

import time
from ctypes import c_int
from functools import cache

import daqp
import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.mpc.config.schema import Weights
from diffdrive_mpc.mpc.config.solver import Solver
from diffdrive_mpc.mpc.problem.constants import HARD_KINDS as HARD
from diffdrive_mpc.mpc.solver.backend import MIN_TIME_LIMIT, Kinds, Program, SetUpTime, Solved
from diffdrive_mpc.mpc.solver.report import SolverStatus

# Exit flags of DAQP for linearly dependent rows in the initial active set, and for the time limit.
_DEPENDENT = -6
_TIME_LIMIT = -7
_STATUS = {
    2: SolverStatus.SOLVED,  # with a violated soft limit
    1: SolverStatus.SOLVED,
    -1: SolverStatus.INFEASIBLE,
    -2: SolverStatus.MAX_ITERATIONS,  # cycling without progress
    -3: SolverStatus.UNBOUNDED,
    -4: SolverStatus.MAX_ITERATIONS,
    -5: SolverStatus.NOT_CONVEX,
    _TIME_LIMIT: SolverStatus.TIME_LIMIT,
}
# Flags of a row; `_NOT_VIOLATED` marks a soft limit that is active but not violated.
_ACTIVE, _LOWER, _SOFT, _NOT_VIOLATED = 1, 2, 8, 32


@cache
def _set_up_time(steps: int) -> SetUpTime:
    """Measure the set-up time per row, for the factorisation of a Hessian (2 N, 2 N) and the scaling of the rows."""
    set_up_time, n = SetUpTime(), 2 * steps
    for _ in range(2):  # the first set-up also loads the library
        sense = np.zeros(n, dtype=c_int)
        with set_up_time.measured(n):
            daqp.Model().setup(np.eye(n) + 1.0, np.zeros(n), np.eye(n), np.ones(n), -np.ones(n), sense)
    return set_up_time


class DaqpBackend:
    """Implementation of `mpc.solver.backend.Backend` with DAQP."""

    def __init__(self, steps: int, kinds: int, settings: Solver, weights: Weights) -> None:
        self._steps, self._count, self._weights = steps, kinds, weights
        self._settings = {"primal_tol": settings.tolerance, "iter_limit": settings.max_iterations}
        self._set_up_time = _set_up_time(steps)
        commands = np.eye(2 * steps)
        increments = commands.copy()
        increments[2:] -= commands[:-2]
        self._hard = [commands[0::2], commands[1::2], increments[0::2], increments[1::2]]

    def solve(
        self,
        program: Program,
        kinds: Kinds,
        guess: FloatArray,
        multipliers: FloatArray,
        time_limit: float | None = None,
    ) -> Solved:
        """Solve the program, see `mpc.solver.backend.Backend`; the guess of the plan is not used."""
        deadline = None if time_limit is None else time.monotonic() + time_limit
        rows = np.concatenate([self._hard[kind] if kind < HARD else program.rows(kind) for kind in kinds])
        indices = list(kinds)
        initial = multipliers[indices].reshape(-1)
        soft = np.repeat([kind >= HARD for kind in kinds], self._steps)
        flag, solution = self._run(program, rows, indices, soft, initial, deadline)
        if flag == _DEPENDENT:
            flag, solution = self._run(program, rows, indices, soft, np.zeros_like(initial), deadline)
        status = _STATUS.get(flag, SolverStatus.NOT_RUN)
        if solution is None:
            return Solved(guess, np.zeros((self._count, self._steps)), status)
        plan, active, iterations = solution
        duals = np.zeros((self._count, self._steps))
        duals[indices] = active.reshape(-1, self._steps)
        # DAQP does not report residuals. Soft rows may exceed their limits, so the primal residual excludes these rows.
        stationarity = program.H @ plan + program.g + rows.T @ active
        values = rows @ plan
        excess = np.maximum(values - program.upper[indices].reshape(-1), program.lower[indices].reshape(-1) - values)
        max_violation = float(np.max(excess[~soft], initial=0.0))
        return Solved(plan, duals, status, iterations, max(max_violation, 0.0), float(np.abs(stationarity).max()))

    def _run(
        self,
        program: Program,
        rows: FloatArray,
        kinds: list[int],
        soft: FloatArray,
        initial: FloatArray,
        deadline: float | None,
    ) -> tuple[int, tuple[FloatArray, FloatArray, int] | None]:
        """Solve from the guess `initial` of the multipliers; return the exit flag of DAQP, and the solution.

        The solution is None if DAQP rejects the data or the remaining time is too short for the set-up.
        """
        if deadline is not None and self._set_up_time.expected(len(rows)) >= deadline - time.monotonic():
            return _TIME_LIMIT, None
        sense = np.where(initial > 0, _ACTIVE, np.where(initial < 0, _ACTIVE | _LOWER, 0)) | np.where(soft, _SOFT, 0)
        # Soft limits of the warm start are marked as not violated. Otherwise DAQP may report success for a point near
        # the solution.
        sense |= np.where(soft & (initial != 0), _NOT_VIOLATED, 0)
        model = daqp.Model()
        with self._set_up_time.measured(len(rows)):
            flag, _ = model.setup(
                np.array(program.H),
                np.array(program.g),
                rows,
                program.upper[kinds].reshape(-1),
                program.lower[kinds].reshape(-1),
                np.ascontiguousarray(sense, dtype=c_int),
            )
        if flag < 0:
            return int(flag), None
        # The time limit of DAQP starts here; DAQP checks it every 32 iterations.
        limit = {} if deadline is None else {"time_limit": max(deadline - time.monotonic(), MIN_TIME_LIMIT)}
        model.settings = {**self._settings, **limit}
        if soft.any():
            # DAQP expects the inverse of the quadratic penalty.
            compliance = np.full(len(initial), 1 / self._weights.soft_quadratic)
            penalties = np.full(len(initial), self._weights.soft)
            model.soft_weights(compliance, compliance, penalties, penalties)
        plan, _, flag, info = model.solve()
        return int(flag), (np.array(plan), np.array(info["lam"]), int(info["iterations"]))
