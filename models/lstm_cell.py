"""Equations of one unit of a long short-term memory, for any library: CasADi, NumPy or JAX.

`tanh` is the function of the library. The logistic function is expressed by tanh, so that no other function is needed.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

Tanh = Callable[[Any], Any]


def logistic(x: Any, tanh: Tanh) -> Any:  # noqa: ANN401 - arrays and symbols of any library
    """Compute the logistic function 1 / (1 + exp(-x))."""
    return 0.5 + 0.5 * tanh(0.5 * x)


def next_cell(enter: Any, keep: Any, candidate: Any, cell: Any, tanh: Tanh) -> Any:  # noqa: ANN401
    """Compute the cell state one sample later, from the weighted sums of its gates before activation."""
    return logistic(keep, tanh) * cell + logistic(enter, tanh) * tanh(candidate)


def hidden(leave: Any, cell: Any, tanh: Tanh) -> Any:  # noqa: ANN401
    """Compute the output of the unit, from the weighted sum of its output gate and the cell state of the sample."""
    return logistic(leave, tanh) * tanh(cell)
