"""Who solves the problem: our controller, and peers that get it stage by stage."""

from __future__ import annotations

from typing import NamedTuple


class SolveReport(NamedTuple):
    """Of the last solve: time inside the solver by its own clock [s], its iterations, whether it found a solution."""

    inside: float
    iterations: int
    solved: bool
