"""What a solver of the condensed problem has to be."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from models.interface import FloatArray
from mpc.config import Solver, Weights
from mpc.qp.limit_rows import LimitRows
from mpc.quadratic_program import Kinds, QuadraticProgram, Relaxed
from mpc.solver_report import SolverReport


@dataclass(slots=True)
class Task:
    """One problem and where to start from.

    Attributes
    ----------
    qp, rows, relaxed
        The problem, its limits, and its minimiser without them.
    values
        (9, N) the limits' rows at that minimiser.
    kinds
        The kinds of limit to keep; a backend may keep more of them.
    guess
        (2 N,) a plan near the solution.
    multipliers
        (9, N) of the limits near the solution: positive at upper bounds, negative at lower ones, else zero.
    """

    qp: QuadraticProgram
    rows: LimitRows
    relaxed: Relaxed
    values: FloatArray
    kinds: Kinds
    guess: FloatArray
    multipliers: FloatArray


@dataclass(frozen=True, slots=True)
class Answer:
    """What a backend found: the flat plan (2 N,), its report, and multipliers (9, N), zero where nothing presses."""

    plan: FloatArray
    report: SolverReport
    multipliers: FloatArray


class Backend(Protocol):
    """A solver with its work space; it never raises on numbers, and carries nothing from task to task but memory."""

    def __init__(self, steps: int, settings: Solver, weights: Weights) -> None: ...

    def solve(self, task: Task) -> Answer:
        """Solve one task."""
        ...
