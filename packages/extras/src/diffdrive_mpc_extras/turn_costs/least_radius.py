"""The least turn radius of a vehicle on a terrain: where the motors of the outer side are at their limit."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.interface import FloatArray

LIMIT_SHARE = 0.95
"""Share of the torque limit that counts as reached; Ordonez et al., 2017 (P4), section 4.2."""

_PER_DECADE = 60


def least_radius(
    outer_torque: Callable[[FloatArray], ArrayLike],
    limit: float,
    radii: tuple[float, float] = (0.05, 1000.0),
    share: float = LIMIT_SHARE,
) -> float:
    """Largest radius at which the outer side needs more than `share` of its torque limit [m]; 0 where none does.

    Parameters
    ----------
    outer_torque
        Torque of the outer side [N m] at radii (n,) [m]; of a model, a network or a table.
    limit
        Largest torque of a side [N m].
    radii
        Where to look, from and to [m].
    share
        Share of the limit.

    Returns
    -------
    float
        The radius; infinity where even the widest turn needs more.

    Raises
    ------
    models.checked_yaml.ConfigError
        If the limit is not a positive number, or a torque not finite.
    """
    if not (math.isfinite(limit) and limit > 0):
        raise ConfigError(f"torque limit {limit} N m: give a positive number")
    low, high = np.log10(radii)
    grid = np.logspace(low, high, max(2, round((high - low) * _PER_DECADE)))
    torque = np.abs(np.asarray(outer_torque(grid), dtype=float))
    if not np.isfinite(torque).all():
        raise ConfigError("the torque is not finite at some radius; no least radius follows from it")
    over = np.flatnonzero(torque > share * limit)
    if not over.size:
        return 0.0
    last = int(over[-1])
    if last == len(grid) - 1:
        return math.inf
    inside, outside = grid[last], grid[last + 1]
    for _ in range(40):
        middle = math.sqrt(inside * outside)
        too_much = abs(float(np.asarray(outer_torque(np.array([middle])))[0])) > share * limit
        inside, outside = (middle, outside) if too_much else (inside, middle)
    return float(math.sqrt(inside * outside))
