"""What a peer says of one solve."""

from __future__ import annotations

from typing import NamedTuple


class Report(NamedTuple):
    """Of the last solve: time inside the solver by its own clock [s], its iterations, whether it found a solution."""

    inside: float
    iterations: int
    solved: bool
