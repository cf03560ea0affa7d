"""The condensed problem as a least-distance problem.

With H = L L' and U = U0 + z / L', U0 the minimiser without limits, the cost is |z|^2 / 2, and the limits are rows of z.
"""

from __future__ import annotations

import numpy as np

from models.interface import FloatArray
from mpc.qp.limit_rows import HARD_KINDS, LimitRows
from mpc.qp.relaxed import inverse_factor
from mpc.quadratic_program import Kinds, QuadraticProgram, Relaxed


class ArrayLeastDistance:
    """Implements `mpc.quadratic_program.LeastDistance` with arrays."""

    def __init__(self, qp: QuadraticProgram, relaxed: Relaxed, kinds: Kinds) -> None:
        limits, plan = LimitRows(len(relaxed.plan) // 2), relaxed.plan
        limits.load(qp)
        chosen, now = list(kinds), limits.values(plan)
        self.upper = (limits.upper - now)[chosen].reshape(-1)
        self.lower = (limits.lower - now)[chosen].reshape(-1)
        self._plan, self._inverse = plan, inverse_factor(relaxed.factor)
        self.rows = np.concatenate([self._rows(qp, kind) for kind in kinds])
        self._hard = sum(kind < HARD_KINDS for kind in kinds) * limits.upper.shape[1]

    def _rows(self, qp: QuadraticProgram, kind: int) -> FloatArray:
        if kind >= HARD_KINDS:
            return np.asarray(qp.soft_rows(kind - HARD_KINDS) @ self._inverse)
        own = self._inverse[kind % 2 :: 2]
        return own if kind < 2 else np.diff(own, axis=0, prepend=0.0)

    def solution(self, z: FloatArray, pressing: FloatArray) -> tuple[FloatArray, float, float]:
        """See `mpc.quadratic_program.LeastDistance`."""
        values = self.rows @ z
        excess = np.maximum(values - self.upper, self.lower - values)[: self._hard]
        dual = np.abs(z + pressing @ self.rows).max()
        return self._plan + self._inverse @ z, float(excess.max(initial=0.0)), float(dual)
