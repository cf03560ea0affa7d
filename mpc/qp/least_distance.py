"""The condensed problem as a least-distance problem.

With H = L L' and U = U0 + z / L', U0 the minimiser without limits, the cost is |z|^2 / 2, and the limits are rows of z.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.mpc.qp.limit_rows import HARD_KINDS, KINDS, LimitRows
from diffdrive_mpc.mpc.qp.relaxed import inverse_factor
from diffdrive_mpc.mpc.quadratic_program import Found, Kinds, QuadraticProgram, Relaxed

# DAQP's flags of a row; the last says of a soft limit that it is kept, though it presses.
_ACTIVE, _LOWER, _SOFT, _KEPT = 1, 2, 8, 32


class ArrayLeastDistance:
    """Implements `mpc.quadratic_program.LeastDistance` with arrays."""

    def __init__(self, qp: QuadraticProgram, relaxed: Relaxed, kinds: Kinds) -> None:
        limits, plan = LimitRows(len(relaxed.plan) // 2), relaxed.plan
        limits.load(qp)
        now, self._kinds = limits.values(plan), list(kinds)
        self.upper = (limits.upper - now)[self._kinds].reshape(-1)
        self.lower = (limits.lower - now)[self._kinds].reshape(-1)
        self._plan, self._inverse = plan, inverse_factor(relaxed.factor)
        self.rows = np.concatenate([self._rows(qp, kind) for kind in kinds])
        self._hard = sum(kind < HARD_KINDS for kind in kinds) * limits.upper.shape[1]

    def _rows(self, qp: QuadraticProgram, kind: int) -> FloatArray:
        if kind >= HARD_KINDS:
            return np.asarray(qp.soft_rows(kind - HARD_KINDS) @ self._inverse)
        own = self._inverse[kind % 2 :: 2]
        return own if kind < 2 else np.diff(own, axis=0, prepend=0.0)

    def flags(self, multipliers: FloatArray, price: float) -> NDArray[np.intc]:
        """See `mpc.quadratic_program.LeastDistance`."""
        flags, soft = np.zeros(len(self.rows), dtype=np.intc), slice(self._hard, None)
        pressing = multipliers[self._kinds].reshape(-1)
        flags[pressing > 0] = _ACTIVE
        flags[pressing < 0] = _ACTIVE | _LOWER
        flags[soft] |= _SOFT
        flags[soft][(pressing[soft] != 0) & (np.abs(pressing[soft]) < price)] |= _KEPT
        return flags

    def found(self, z: FloatArray, pressing: FloatArray) -> Found:
        """See `mpc.quadratic_program.LeastDistance`."""
        values = self.rows @ z
        excess = np.maximum(values - self.upper, self.lower - values)[: self._hard]
        residual = np.abs(z + pressing @ self.rows).max()
        multipliers = np.zeros((KINDS, len(z) // 2))
        multipliers[self._kinds] = pressing.reshape(len(self._kinds), -1)
        kinds = tuple(np.flatnonzero(multipliers.any(axis=1)).tolist())
        return Found(
            self._plan + self._inverse @ z, float(excess.max(initial=0.0)), float(residual), multipliers, kinds
        )
