"""What a solver of the condensed problem has to be."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.mpc.config.schema import Weights
from diffdrive_mpc.mpc.config.solver import Solver
from diffdrive_mpc.mpc.quadratic_program import Kinds, QuadraticProgram, Relaxed
from diffdrive_mpc.mpc.solver_report import SolverReport

MOST_WORKSPACES = 16
"""Work spaces that a backend keeps, one for each set of kinds of limit; few sets come up in practice."""


@dataclass(slots=True)
class Task:
    """One problem and where to start from.

    Attributes
    ----------
    qp, relaxed
        The problem, and its minimiser without limits.
    kinds
        The kinds of limit to keep.
    guess
        (2 N,) a plan near the solution.
    multipliers
        (9, N) of the limits near the solution: positive at upper bounds, negative at lower ones, else zero.
    """

    qp: QuadraticProgram
    relaxed: Relaxed
    kinds: Kinds
    guess: FloatArray
    multipliers: FloatArray


class Answer(NamedTuple):
    """What a backend found.

    Attributes
    ----------
    plan
        (2 N,) the flat plan.
    report
        What the solver says of it.
    multipliers
        (9, N) of the limits, zero where nothing presses.
    kinds
        The kinds of limit that press somewhere.
    """

    plan: FloatArray
    report: SolverReport
    multipliers: FloatArray
    kinds: Kinds


class Backend(Protocol):
    """A solver with its work space; it never raises on numbers, and carries nothing from task to task but memory."""

    def __init__(self, steps: int, settings: Solver, weights: Weights) -> None: ...

    def solve(self, task: Task) -> Answer:
        """Solve one task."""
        ...
