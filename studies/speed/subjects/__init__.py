"""Solvers of the problem: our controller, and peers that get it stage by stage."""

from __future__ import annotations

from typing import NamedTuple


class SolveReport(NamedTuple):
    """Report of the last solve: time by the solver's clock [s], iterations, and True with a solution."""

    inside: float
    iterations: int
    solved: bool
