"""What a backend of the condensed problem has to be."""

from __future__ import annotations

from typing import Protocol

from models.interface import FloatArray
from mpc.condensed import QuadraticProgram
from mpc.config import Solver, Weights
from mpc.qp.hard_rows import HardRows
from mpc.qp.multipliers import Multipliers
from mpc.qp.relaxed import Relaxed
from mpc.solver_report import SolverReport

Kinds = tuple[int, ...]
"""Which of the five kinds of soft limit a problem includes, ascending."""


class Workspace(Protocol):
    """A solver of fixed size and sparsity for the hard limits and some kinds of soft limits."""

    def __init__(self, steps: int, settings: Solver, weights: Weights, kinds: Kinds) -> None: ...

    def solve(
        self, qp: QuadraticProgram, relaxed: Relaxed, hard: HardRows, guess: FloatArray, start: Multipliers
    ) -> tuple[FloatArray, SolverReport, Multipliers]:
        """Solve for the kinds of this work space; never raises on numbers.

        Parameters
        ----------
        qp
            The problem.
        relaxed
            Its minimiser without limits.
        hard
            Its hard limits.
        guess
            (2 N,) plan to start from.
        start
            Multipliers to start from.

        Returns
        -------
        tuple
            The flat plan (2 N,), the report, and the multipliers; zero where a limit is not active.
        """
        ...
