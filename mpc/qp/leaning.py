"""Lean on the limits that pressed at the last tick, and see whether that is the solution.

Where the right limits are known, the solution is that of a linear system. Multipliers of the right sign and limits
that are kept prove it: then no iterative solver is needed, whatever its tolerance. If not, limits that are broken come
in and those that pull go, a few times at most: steps of the primal-dual active set method (Hintermüller, Ito, Kunisch,
SIAM Journal on Optimization 13(3), 2002). It may go round in circles here, so a solver has to stand by.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.mpc.quadratic_program import LeastDistance

# More rounds rarely help: what is not found by then mostly goes round in circles.
_ROUNDS = 5


class Leaning(NamedTuple):
    """A solution that is proven.

    Attributes
    ----------
    z
        (n,) the solution.
    pressing
        (m,) how much each row presses, positive at upper bounds, negative at lower ones.
    rounds
        How many sets of limits were tried.
    """

    z: FloatArray
    pressing: FloatArray
    rounds: int


def lean_on(problem: LeastDistance, near: FloatArray, slack: float) -> Leaning | None:
    """The solution of a least-distance problem without soft limits, from the limits that press near it.

    Parameters
    ----------
    problem
        m rows in n variables.
    near
        (m,) positive where an upper bound presses, negative where a lower one does, else zero.
    slack
        By how much a limit may be exceeded.

    Returns
    -------
    Leaning or None
        None where nothing was proven to be the solution.
    """
    rows, upper, lower = problem.rows, problem.upper, problem.lower
    signs = np.sign(near)
    for rounds in range(1, _ROUNDS + 1):
        active = np.flatnonzero(signs)
        chosen = rows[active]
        bound = np.where(signs[active] > 0, upper[active], lower[active])
        try:
            pressing = -np.linalg.solve(chosen @ chosen.T, bound)
        except np.linalg.LinAlgError:
            return None
        z = -(pressing @ chosen)
        values = rows @ z
        # Not the other way round, here and below: NaN proves nothing.
        kept = (values <= upper + slack) & (values >= lower - slack)
        pushes = pressing * signs[active] >= 0
        if kept.all() and pushes.all():
            # A nearly singular system has solutions that miss their bounds.
            if not np.abs(values[active] - bound).max(initial=0.0) <= slack:
                return None
            spread = np.zeros(len(signs))
            spread[active] = pressing
            return Leaning(z, spread, rounds)
        signs[active[~pushes]] = 0.0
        signs[~kept] = np.sign(values[~kept] - upper[~kept] + values[~kept] - lower[~kept])
    return None
