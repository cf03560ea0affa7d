"""Weights that keep outliers from deciding.

In a log an outlier is a reading that its neighbours contradict. What a model cannot explain lasts longer than that, and
is no outlier: holding it back would fit the quiet parts of a log and give up the rest.

Source of the weights: Huber, Robust Statistics, Wiley 1981: min(1, c / |z|) of residuals z over their scale.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import ndimage

from diffdrive_mpc.models.identification.output_error.stretch import Stretch
from diffdrive_mpc.models.interface import FloatArray

_SPIKE = 5.0
"""c for single readings: on normal noise next to none is held back."""
_NEIGHBOURS = 5
# The median size of a normal variable is this part of its standard deviation.
_MEDIAN = 0.6745
# The scale of spikes is not taken below this part of the residuals.
_LEAST_SHARE = 0.1


def spike_weights(residuals: Sequence[FloatArray]) -> list[FloatArray]:
    """For each stretch (K, p) weights of its residuals (K, p), NaN where they do not count: 1, and less for spikes.

    A spike is the difference from the median of five readings around; its scale is the median of all that differ. (The
    quantised readings of a robot that stands do not, and say nothing about noise.)
    """
    spikes = [np.full_like(rows, np.nan) for rows in residuals]
    for spike, rows in zip(spikes, residuals, strict=True):
        for column in range(rows.shape[1]):
            known = np.isfinite(rows[:, column])
            reading = rows[known, column]
            spike[known, column] = reading - ndimage.median_filter(reading, _NEIGHBOURS, mode="nearest")
    whole = np.concatenate(residuals)
    size = np.abs(np.concatenate(spikes))
    scale = np.array([_median(column[column > 0]) for column in size.T]) / _MEDIAN
    scale = np.maximum(scale, _LEAST_SHARE * np.sqrt(np.nanmean(whole**2, axis=0)) + np.finfo(float).tiny)
    return [_SPIKE / np.maximum(np.nan_to_num(np.abs(spike / scale)), _SPIKE) for spike in spikes]


def residual_scale(residuals: Sequence[FloatArray], weights: Sequence[FloatArray], spread: FloatArray) -> FloatArray:
    """(p,) root mean square of weighted residuals (K, p), NaN where they do not count.

    Never below a tiny part of the outputs' `spread` (p,), which keeps noise-free data from dividing by zero.
    """
    weighted = np.concatenate([weight * rows for weight, rows in zip(weights, residuals, strict=True)])
    return np.asarray(np.maximum(np.sqrt(np.nanmean(weighted**2, axis=0)), 1e-9 * spread))


def output_spread(stretches: Sequence[Stretch]) -> FloatArray:
    """(p,) standard deviation of each output; raises ValueError where one never changes."""
    spread = []
    for row in range(stretches[0].outputs.shape[1]):
        spread.append(np.std(np.concatenate([s.outputs[s.counts[:, row], row] for s in stretches])))
    if min(spread) == 0.0:
        raise ValueError("the outputs never change: is the sensor connected, and did the robot move?")
    return np.array(spread)


def _median(values: FloatArray) -> float:
    return float(np.median(values)) if len(values) else 0.0
