"""The rows of free space among the soft limits: one shipped term for each, whose C comes with the core."""

from __future__ import annotations

from dataclasses import dataclass

from diffdrive_mpc.mpc.config.free_space import FreeSpace
from diffdrive_mpc.mpc.problem.half_space import half_space_function
from diffdrive_mpc.mpc.problem.terms import Term

_ANYWHERE = (0.0, 0.0, 0.0, 0.0, 1.0)


@dataclass(frozen=True, eq=False)
class ShippedTerm(Term):
    """A term whose function is in the compiled library.

    Attributes
    ----------
    symbol
        Its name there.
    """

    symbol: str = ""


def half_space_terms(config: FreeSpace) -> tuple[ShippedTerm, ...]:
    """The rows of a configuration; none unless it is enabled."""
    if not config.enabled:
        return ()
    function = half_space_function()
    return tuple(
        ShippedTerm(f"free_space_{row}", function, "soft", 0.0, None, _ANYWHERE, symbol="ddmpc_f_half_space")
        for row in range(config.rows)
    )
