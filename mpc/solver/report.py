"""What the solver says about one tick; it travels with every command."""

from __future__ import annotations

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

    @property
    def usable(self) -> bool:
        """Whether a command may be taken from such a solution."""
        return self in (SolverStatus.SOLVED, SolverStatus.SOLVED_INACCURATELY)


class SolverPath(StrEnum):
    """The way that led to the plan of a tick; where a backend was asked, the way is its name in the configuration."""

    NONE = "none"
    """Nothing was solved."""
    UNLIMITED = "unlimited"
    """No limit presses: the minimiser without limits keeps them all. One factorisation."""
    ACTIVE_SET = "active_set"
    """The limits that press were found and proven by their multipliers."""


@dataclass(frozen=True)
class SolverReport:
    """Status, way, effort and accuracy of one tick's solution.

    Attributes
    ----------
    status
        The outcome; only a `usable` one may move the robot.
    path
        The way that was taken: "none", "unlimited", "active_set", or the name of the backend that was asked.
    iterations
        Iterations over all solves of the tick: of the backend, or systems of the active set; 0 where the minimiser
        without limits keeps them all and so is the exact solution.
    primal_residual, dual_residual
        By how much limits are exceeded and how far the cost is from stationary: OSQP's own figures at its end, else
        computed from the solution. NaN if there is none.
    soft_limits
        Whether soft limits took part.
    """

    status: SolverStatus
    path: str = SolverPath.NONE
    iterations: int = 0
    primal_residual: float = float("nan")
    dual_residual: float = float("nan")
    soft_limits: bool = False
