"""The two exact ways through one tick's problem: condensed to the commands, or sparse with states and poses."""

from __future__ import annotations

from typing import Protocol

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.mpc.compiled.condenser import CompiledCondenser
from diffdrive_mpc.mpc.condensed import Condenser
from diffdrive_mpc.mpc.problem import TrackingProblem
from diffdrive_mpc.mpc.qp.condensed_solver import CondensedSolver
from diffdrive_mpc.mpc.qp.solution import Solution
from diffdrive_mpc.mpc.sparse.solver import SparseSolver
from diffdrive_mpc.mpc.tick import Tick


class Way(Protocol):
    """Linearises a tick along a plan and solves what results."""

    def solve(self, tick: Tick, guess: FloatArray) -> Solution:
        """One real-time iteration from the plan `guess` (N, 2). Never raises on numbers: see the report's status."""
        ...

    def reset(self) -> None:
        """Forget every earlier solve."""
        ...


class CondensedWay:
    """Condense to a small dense program in the commands, and solve that."""

    def __init__(self, problem: TrackingProblem, condenser: Condenser | CompiledCondenser) -> None:
        config = problem.config
        self._condenser = condenser
        self._solver = CondensedSolver(config.horizon, config.solver, config.weights)

    def solve(self, tick: Tick, guess: FloatArray) -> Solution:
        """See `Way`."""
        return self._solver.solve(self._condenser.condense(tick, guess), guess)

    def reset(self) -> None:
        """See `Way`."""
        self._solver.reset()


def make_way(problem: TrackingProblem, condenser: Condenser | CompiledCondenser) -> Way:
    """The way that the problem's configuration asks for."""
    if problem.config.solver.formulation == "sparse":
        return SparseSolver(problem)
    return CondensedWay(problem, condenser)
