"""What the limits of a solution press with: a warm start that any backend, with any soft limits, can begin from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from models.interface import FloatArray

SOFT_KINDS = 5


@dataclass(frozen=True, slots=True)
class Multipliers:
    """Lagrange multipliers of a condensed problem: positive at upper limits, negative at lower ones.

    Attributes
    ----------
    hard
        (2, N, 2) those of the commands and of their increments.
    soft
        (5, N) those of the soft limits.
    """

    hard: FloatArray
    soft: FloatArray

    @classmethod
    def none(cls, steps: int) -> Multipliers:
        """Nothing presses."""
        return cls(np.zeros((2, steps, 2)), np.zeros((SOFT_KINDS, steps)))

    @property
    def kinds(self) -> tuple[int, ...]:
        """The kinds of soft limit that press somewhere."""
        return tuple(np.flatnonzero(self.soft.any(axis=1)).tolist())

    def shifted(self) -> Multipliers:
        """Those of the next tick if everything goes to plan: one step ahead, the last one twice."""
        hard, soft = np.empty_like(self.hard), np.empty_like(self.soft)
        hard[:, :-1], hard[:, -1] = self.hard[:, 1:], self.hard[:, -1]
        soft[:, :-1], soft[:, -1] = self.soft[:, 1:], self.soft[:, -1]
        return Multipliers(hard, soft)
