"""One rule and its verdict."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike


@dataclass(frozen=True)
class Finding:
    """A finding of a paper, put as a rule.

    Attributes
    ----------
    claim
        The rule, as a sentence that is true or not.
    source
        Whose finding it is, and where it stands.
    published, plant
        The numbers behind it, in the paper and on the simulated robot (means over repetitions).
    holds
        For each repetition, whether the rule holds there.
    """

    claim: str
    source: str
    published: str
    plant: str
    holds: tuple[bool, ...]

    @property
    def verdict(self) -> str:
        """Yes, no, or in how many repetitions."""
        if all(self.holds):
            return "yes"
        return f"{sum(self.holds)} of {len(self.holds)}" if any(self.holds) else "no"


def each(flags: ArrayLike) -> tuple[bool, ...]:
    """Flags (repetitions,) as plain truth values."""
    return tuple(bool(flag) for flag in np.atleast_1d(flags))
