"""Report of the solver about one tick; it accompanies every command."""

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
    """The method that gave the plan of a tick; a backend has its name in the configuration instead."""

    NONE = "none"
    """Nothing was solved."""
    UNLIMITED = "unlimited"
    """No limit is active: the minimiser without limits keeps them all. One factorisation."""
    ACTIVE_SET = "active_set"
    """The active limits were identified, and proven by their multipliers."""


@dataclass(frozen=True)
class SolverReport:
    """Status, method, effort and accuracy of one tick's solution.

    Attributes
    ----------
    status
        The outcome; only a `usable` one may move the robot.
    method
        "none", "unlimited", "active_set", or the name of the backend that was asked.
    iterations
        Iterations over all solves of the tick: of the backend, or systems of the active set; 0 where the minimiser
        without limits keeps them all and so is the exact solution.
    primal_residual, dual_residual
        Largest violation of a limit, and largest residual of the stationarity condition: OSQP's own figures at its end,
        else computed from the solution. NaN if there is none.
    soft_limits
        Whether the problem had soft limits.
    operations
        Operations of the active set: multiplications of its loops, also where a backend was used after it. At most
        `Controller.operations_bound`; docs/tuning.md says how they are counted.
    missed
        Ticks in a row, this one included, whose solve was cut off by the deadline or ended after it; from
        `solver.max_missed` on the robot brakes.
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
        """Return `method`, which it was called before; it warns."""
        warnings.warn("SolverReport.path is SolverReport.method now", DeprecationWarning, stacklevel=2)
        return self.method
