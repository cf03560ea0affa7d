"""What a position error consists of: what every seed repeats, and what differs from seed to seed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from diffdrive_mpc.bench.tracking.row import Row


@dataclass(frozen=True)
class ErrorParts:
    """Mean squares that add up to the mean squared position error [m^2].

    Attributes
    ----------
    bias
        Across the path, in steady arcs, the same for every seed: what slip and gains leave behind.
    transient
        Across the path, at all other times, the same for every seed: entries, exits, straights.
    along
        Along the path, the same for every seed.
    noise
        What differs from seed to seed: sensors.
    """

    bias: float
    transient: float
    along: float
    noise: float

    @property
    def total(self) -> float:
        """Mean squared position error [m^2]."""
        return self.bias + self.transient + self.along + self.noise


def decompose(rows: Sequence[Row]) -> ErrorParts:
    """Split the mean squared error of runs of one case that differ in their seeds.

    With S seeds the square of the mean over seeds still holds 1/S of the noise's variance; it is taken off there and
    counted as noise, so that both parts are unbiased and the sum stays exact. A single run has no noise to see: all of
    its error counts as repeated.

    Raises
    ------
    ValueError
        If the runs are of different length.
    """
    lengths = {len(row.time) for row in rows}
    if len(lengths) != 1:
        raise ValueError(f"runs of {sorted(lengths)} ticks cannot be compared tick by tick")
    across, along = (np.array([getattr(row, name) for row in rows]) for name in ("across", "along"))
    steady = rows[0].steady
    several = len(rows) > 1
    spread = [series.var(axis=0, ddof=1) if several else np.zeros(series.shape[1]) for series in (across, along)]
    repeated = [series.mean(axis=0) ** 2 - var / len(rows) for series, var in zip((across, along), spread, strict=True)]
    return ErrorParts(
        bias=float(np.mean(np.where(steady, repeated[0], 0.0))),
        transient=float(np.mean(np.where(steady, 0.0, repeated[0]))),
        along=float(np.mean(repeated[1])),
        noise=float(np.mean(spread[0] + spread[1])),
    )
