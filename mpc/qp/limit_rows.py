"""All limits of the condensed problem as rows, ordered by kind: lower <= values(U) <= upper."""

from __future__ import annotations

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.mpc.quadratic_program import Kinds, QuadraticProgram

HARD_KINDS, SOFT_KINDS = 4, 5
KINDS = HARD_KINDS + SOFT_KINDS
"""v_ref, omega_ref and their increments, which are hard; then v, omega, right and left wheel, distance across."""


class LimitRows:
    """Values and bounds of all rows, (9, N): one row per kind and step. Holds those of the problem last loaded.

    Attributes
    ----------
    lower, upper
        (9, N) bounds.
    """

    def __init__(self, steps: int) -> None:
        self.lower, self.upper = np.empty((KINDS, steps)), np.empty((KINDS, steps))
        self._qp: QuadraticProgram | None = None

    def load(self, qp: QuadraticProgram) -> None:
        """Take over the limits of `qp`."""
        upper, lower, self._qp = self.upper, self.lower, qp
        upper[:2] = qp.box.reshape(-1, 2).T
        upper[2:HARD_KINDS] = qp.slew[:, None]
        np.negative(upper[:HARD_KINDS], out=lower[:HARD_KINDS])
        upper[HARD_KINDS:], lower[HARD_KINDS:] = qp.soft_upper, qp.soft_lower

    def values(self, plan: FloatArray) -> FloatArray:
        """(9, N) the rows at the flat `plan` (2 N,)."""
        assert self._qp is not None
        values = np.empty_like(self.upper)
        values[:2] = plan.reshape(-1, 2).T
        np.subtract(values[:2, 0], self._qp.last_command, out=values[2:HARD_KINDS, 0])
        np.subtract(values[:2, 1:], values[:2, :-1], out=values[2:HARD_KINDS, 1:])
        values[HARD_KINDS:] = self._qp.soft_values(plan)
        return values

    def excess(self, values: FloatArray) -> FloatArray:
        """(9, N) by how much `values` lie beyond their bounds; negative inside."""
        return np.maximum(values - self.upper, self.lower - values)


def broken(excess: FloatArray, slack: float) -> Kinds:
    """Kinds of limit that are exceeded somewhere by more than `slack`."""
    if excess.max() <= slack:
        return ()
    return tuple(np.flatnonzero(excess.max(axis=1) > slack).tolist())
