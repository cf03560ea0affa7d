"""FIT: how much of a measured signal a simulation explains."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from diffdrive_mpc.models.interface import FloatArray


def fit_percent(measured: FloatArray, simulated: FloatArray) -> float:
    """FIT = 100 (1 - |y - yhat| / |y - mean(y)|) [%] of one signal (K,).

    Source: Guffanti et al., Sensors 2025, 25(11), 3553. 100 is a perfect simulation, 0 no better than the mean.

    Raises
    ------
    ValueError
        If the measured signal is constant: FIT is not defined then.
    """
    return pooled_fit_percent([measured], [simulated])


def pooled_fit_percent(measured: Sequence[FloatArray], simulated: Sequence[FloatArray]) -> float:
    """FIT [%] over several stretches of one signal, each against the mean of all; raises as `fit_percent`."""
    y, yhat = np.concatenate(measured), np.concatenate(simulated)
    spread = float(np.linalg.norm(y - y.mean()))
    if spread == 0.0:
        raise ValueError("FIT is not defined: the measured signal is constant; use a log in which the robot moves")
    return 100.0 * (1.0 - float(np.linalg.norm(y - yhat)) / spread)
