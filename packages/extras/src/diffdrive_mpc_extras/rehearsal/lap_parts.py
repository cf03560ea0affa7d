"""What laps along one reference have in common."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from diffdrive_mpc.sim.run import Run


class LapParts(NamedTuple):
    """Root mean squares of the position error of laps [m]; their squares add up to that of all laps."""

    repeating: float
    """of what is the same at the same time of every lap"""
    other: float
    """of the rest, which no correction learned from other laps can remove"""


def lap_parts(runs: Sequence[Run]) -> LapParts:
    """Part the position errors of K laps into their mean over the laps and the rest.

    Of that rest 1 / K is still in the mean; both parts are without that bias.

    Raises
    ------
    ValueError
        If there are fewer than two laps, or they have not the same ticks.
    """
    shapes = {run.true_pose[run.counted].shape for run in runs}
    if len(runs) < 2 or len(shapes) > 1:
        raise ValueError(f"{len(runs)} laps of {len(shapes)} lengths: give two or more that were driven to the end")
    errors = np.array([(run.true_pose - run.reference_pose)[run.counted, :2] for run in runs])
    mean = errors.mean(axis=0)
    other = np.sum((errors - mean) ** 2) / (len(runs) - 1) / mean.shape[0]
    repeating = np.sum(mean**2) / mean.shape[0] - other / len(runs)
    return LapParts(float(np.sqrt(max(repeating, 0.0))), float(np.sqrt(other)))
