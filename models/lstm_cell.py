"""The equations of one unit of a long short-term memory, for any library: CasADi, NumPy or JAX.

`tanh` is the library's. The logistic function is written by it, so that a library needs nothing else.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

Tanh = Callable[[Any], Any]


def logistic(x: Any, tanh: Tanh) -> Any:  # noqa: ANN401 - arrays and symbols of any library
    """Compute 1 / (1 + exp(-x))."""
    return 0.5 + 0.5 * tanh(0.5 * x)


def next_cell(enter: Any, keep: Any, candidate: Any, cell: Any, tanh: Tanh) -> Any:  # noqa: ANN401
    """Compute the cell one sample later, for the weighted sums of its three gates before their activation."""
    return logistic(keep, tanh) * cell + logistic(enter, tanh) * tanh(candidate)


def hidden(leave: Any, cell: Any, tanh: Tanh) -> Any:  # noqa: ANN401
    """Compute the output of the unit, for the weighted sum of its output gate and its cell at the same sample."""
    return logistic(leave, tanh) * tanh(cell)
