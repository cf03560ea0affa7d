"""Report on the solve of a tick."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class SolverStatus(StrEnum):
    """Outcome of a solve; the values are texts for messages, and the names match `ddmpc_solver_status` in core.h."""

    SOLVED = "solved"
    SOLVED_INACCURATELY = "solved with a looser tolerance"
    MAX_ITERATIONS = "the iteration limit was reached"
    TIME_LIMIT = "the time limit was reached"
    INFEASIBLE = "the problem has no solution"
    UNBOUNDED = "the problem is unbounded"
    NOT_CONVEX = "the problem is not convex"
    NOT_FINITE = "the problem's data are not finite, or too large to be real"
    REFUSED = "the solver refused the problem's data"
    NOT_RUN = "the solver did not run"
    STOPPED = "stopped at its bounds on iterations, operations or memory: only ranges and slew are certainly satisfied"
    STOPPED_IN_TIME = "stopped at its deadline: only ranges and slew are certainly satisfied"

    @property
    def usable(self) -> bool:
        """True if the solution may be used for a command."""
        return self in _USABLE


_USABLE = frozenset(
    (SolverStatus.SOLVED, SolverStatus.SOLVED_INACCURATELY, SolverStatus.STOPPED, SolverStatus.STOPPED_IN_TIME)
)


class SolverMethod(StrEnum):
    """Method that computed the plan of a tick; the method of a backend is its name in the configuration."""

    NONE = "none"
    """No problem was solved."""
    UNLIMITED = "unlimited"
    """The unconstrained minimiser satisfies all limits; only one factorisation is needed."""
    ACTIVE_SET = "active_set"
    """The active limits were identified and verified by their multipliers."""


@dataclass(frozen=True)
class SolverReport:
    """Status, method, effort and accuracy of the solve of a tick.

    Attributes
    ----------
    status
        Outcome of the solve; the plan is used only if the status is `usable`.
    method
        "none", "unlimited", "active_set", or the name of the backend.
    iterations
        Total iterations of the backend, or linear systems of the active set; 0 if the unconstrained minimiser satisfies
        all limits and is therefore the exact solution.
    primal_residual, dual_residual
        Maximum violation of a limit, and maximum residual of the stationarity condition; NaN if there is no solution.
        OSQP reports these values; for other methods they are computed from the solution.
    soft_limits
        True if the problem had soft limits.
    operations
        Number of multiplications in the loops of the active set, at most `Controller.operations_bound`, even if a
        backend was used afterwards; see docs/tuning.md.
    missed
        Number of consecutive ticks, including the current tick, whose solve was stopped by the deadline or ended after
        it; at `solver.max_missed` the robot brakes.
    """

    status: SolverStatus
    method: str = SolverMethod.NONE
    iterations: int = 0
    primal_residual: float = float("nan")
    dual_residual: float = float("nan")
    soft_limits: bool = False
    operations: int = 0
    missed: int = 0
