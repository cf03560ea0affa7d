"""What a solver says about one solve; it travels with every command."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum


class SolverStatus(StrEnum):
    """Outcome of one solve, as a sentence for people."""

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


@dataclass(frozen=True)
class SolverReport:
    """Status, effort and accuracy of one solve.

    Attributes
    ----------
    status
        The outcome; only a `usable` one may move the robot.
    iterations
        Iterations of the solver, over all solves of the tick; 0 where the minimiser without limits keeps them all and
        so is the exact solution.
    primal_residual, dual_residual
        By how much limits are exceeded and how far the cost is from stationary: OSQP's own figures at its end, else
        computed from the solution. NaN if there is none.
    soft_limits
        Whether the solve included the soft limits: it does only while they matter.
    """

    status: SolverStatus
    iterations: int = 0
    primal_residual: float = float("nan")
    dual_residual: float = float("nan")
    soft_limits: bool = False

    def after(self, iterations: int) -> SolverReport:
        """The same with the `iterations` of all solves of the tick."""
        return self if iterations == self.iterations else replace(self, iterations=iterations)
