"""All limits of the condensed problem as rows, ordered by kind: lower <= values(U) <= upper."""

from __future__ import annotations

import numpy as np

from models.interface import FloatArray
from mpc.quadratic_program import QuadraticProgram

HARD_KINDS, SOFT_KINDS = 4, 5
KINDS = HARD_KINDS + SOFT_KINDS
"""v_ref, omega_ref and their increments, which are hard; then v, omega, right and left wheel, distance across."""

Kinds = tuple[int, ...]
"""Some of the kinds of limit, ascending."""


class LimitRows:
    """Values and bounds of all rows, (9, N): one row per kind and step. Holds those of the problem last loaded.

    Attributes
    ----------
    lower, upper
        (9, N) bounds.
    soft
        (5 N, 2 N) the gradients of the soft rows.
    """

    def __init__(self, steps: int) -> None:
        self.lower, self.upper = np.empty((KINDS, steps)), np.empty((KINDS, steps))
        self.soft = np.empty((0, 2 * steps))
        self._last = np.zeros(2)

    def load(self, qp: QuadraticProgram) -> None:
        """Take over the limits of `qp`."""
        upper, lower, soft = self.upper, self.lower, qp.soft
        upper[:2] = qp.box.reshape(-1, 2).T
        upper[2:HARD_KINDS] = qp.slew[:, None]
        np.negative(upper[:HARD_KINDS], out=lower[:HARD_KINDS])
        upper[HARD_KINDS:], lower[HARD_KINDS:] = qp.soft_upper, qp.soft_lower
        self.soft = soft.reshape(-1, soft.shape[2])
        self._last = qp.last_command

    def values(self, plan: FloatArray) -> FloatArray:
        """(9, N) the rows at the flat `plan` (2 N,)."""
        values = np.empty_like(self.upper)
        values[:2] = plan.reshape(-1, 2).T
        np.subtract(values[:2, 0], self._last, out=values[2:HARD_KINDS, 0])
        np.subtract(values[:2, 1:], values[:2, :-1], out=values[2:HARD_KINDS, 1:])
        np.dot(self.soft, plan, out=values[HARD_KINDS:].reshape(-1))
        return values

    def excess(self, values: FloatArray) -> FloatArray:
        """(9, N) by how much `values` lie beyond their bounds; negative inside."""
        return np.maximum(values - self.upper, self.lower - values)


def broken(excess: FloatArray, slack: float) -> Kinds:
    """Kinds of limit that are exceeded somewhere by more than `slack`."""
    if excess.max() <= slack:
        return ()
    return tuple(np.flatnonzero(excess.max(axis=1) > slack).tolist())
