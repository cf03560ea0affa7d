"""Solvers of the problem: our controller, and peers that solve it by stages."""

from __future__ import annotations

from typing import NamedTuple


class SolveReport(NamedTuple):
    """Report of the last solve: time reported by the solver [s], iterations, and True if it was solved."""

    inside: float
    iterations: int
    solved: bool
