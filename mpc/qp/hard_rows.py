"""The hard limits of the condensed problem as rows: |rows(U)| <= limit."""

from __future__ import annotations

import numpy as np

from models.interface import FloatArray
from mpc.condensed import QuadraticProgram


class HardRows:
    """Range and increment of every command: the first 2 N rows are U, the others its increments.

    Attributes
    ----------
    limit
        (4 N,) bound of each row's magnitude, from the problem last loaded.
    """

    def __init__(self, steps: int) -> None:
        self._n = 2 * steps
        self.limit = np.empty(2 * self._n)
        self._slew = self.limit[self._n :].reshape(steps, 2)
        self._last = np.zeros(2)

    def load(self, qp: QuadraticProgram) -> None:
        """Take over the limits of `qp`."""
        self.limit[: self._n] = qp.box
        self._slew[:] = qp.slew
        self._last = qp.last_command

    def values(self, plan: FloatArray) -> FloatArray:
        """(4 N,) the rows at the flat `plan` (2 N,)."""
        n, rows = self._n, np.empty(2 * self._n)
        rows[:n] = plan
        np.subtract(plan[:2], self._last, out=rows[n : n + 2])
        np.subtract(plan[2:], plan[:-2], out=rows[n + 2 :])
        return rows

    def keeps(self, values: FloatArray) -> bool:
        """Whether all rows are inside their limits."""
        return bool((np.abs(values) <= self.limit).all())
