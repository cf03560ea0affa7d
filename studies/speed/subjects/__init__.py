"""Solvers of the tracking problem: our controller, and peers that solve the problem in stages."""

from __future__ import annotations

from typing import NamedTuple


class SolveReport(NamedTuple):
    """Report of the last solve: time reported by the solver [s], iterations, and success flag."""

    inside: float
    iterations: int
    solved: bool
