"""Report of the solver for one tick; each command comes with one."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from enum import StrEnum


class SolverStatus(StrEnum):
    """Outcome of one solve, as a sentence for people. The names are those of `ddmpc_solver_status` in core.h."""

    SOLVED = "solved"
    SOLVED_INACCURATELY = "solved, but only to a looser tolerance"
    MAX_ITERATIONS = "the iteration limit was reached"
    TIME_LIMIT = "the time limit was reached"
    INFEASIBLE = "the problem has no solution"
    UNBOUNDED = "the problem is unbounded"
    NOT_CONVEX = "the problem is not convex"
    NOT_FINITE = "the problem's data are not finite, or too large to be real"
    REFUSED = "the solver refused the problem's data"
    NOT_RUN = "the solver did not run"
    STOPPED = (
        "stopped by its bounds on iterations, operations or room: ranges and slew are kept, the rest as far as it got"
    )
    STOPPED_IN_TIME = "stopped by the clock: ranges and slew are kept, the rest as far as it got"

    @property
    def usable(self) -> bool:
        """True if a command may be taken from such a solution."""
        return self in _USABLE


_USABLE = frozenset(
    (SolverStatus.SOLVED, SolverStatus.SOLVED_INACCURATELY, SolverStatus.STOPPED, SolverStatus.STOPPED_IN_TIME)
)


class SolverMethod(StrEnum):
    """Method that computed the plan of a tick; a backend is identified by its name in the configuration."""

    NONE = "none"
    """No problem was solved."""
    UNLIMITED = "unlimited"
    """No limit is active: the unconstrained minimiser satisfies all limits. One factorisation."""
    ACTIVE_SET = "active_set"
    """The active limits were identified, and verified by their multipliers."""


@dataclass(frozen=True)
class SolverReport:
    """Status, method, effort and accuracy of one tick's solution.

    Attributes
    ----------
    status
        Outcome of the solve; the plan is used only if the status is `usable`.
    method
        "none", "unlimited", "active_set", or the name of the backend.
    iterations
        Iterations over all solves of the tick: of the backend, or linear systems of the active set; 0 if the
        unconstrained minimiser satisfies all limits, and therefore is the exact solution.
    primal_residual, dual_residual
        Largest violation of a limit, and largest residual of the stationarity condition: as reported by OSQP, else
        computed from the solution. NaN if there is no solution.
    soft_limits
        True if the problem had soft limits.
    operations
        Operations of the active set: multiplications in its loops, also if a backend was used afterwards. At most
        `Controller.operations_bound`; docs/tuning.md explains the count.
    missed
        Consecutive ticks, including this one, whose solve was cut off by the deadline or ended after it; at
        `solver.max_missed` the robot brakes.
    """

    status: SolverStatus
    method: str = SolverMethod.NONE
    iterations: int = 0
    primal_residual: float = float("nan")
    dual_residual: float = float("nan")
    soft_limits: bool = False
    operations: int = 0
    missed: int = 0

    @property
    def path(self) -> str:
        """Return `method`; deprecated, emits DeprecationWarning."""
        warnings.warn("SolverReport.path is SolverReport.method now", DeprecationWarning, stacklevel=2)
        return self.method
