"""Weights that keep outliers from deciding.

Source: Huber, Robust Statistics, Wiley 1981: minimax weights min(1, c / |z|) of residuals z over their scale.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from models.identification.output_error.stretch import Stretch
from models.interface import FloatArray

HUBER = 2.0
"""c: residuals beyond so many scales are held back. On normal noise it costs one percent of efficiency."""
# A normal variable stays within these multiples of its standard deviation for a half and nine tenths of the time.
_MEDIAN, _NINE_TENTHS = 0.6745, 1.6449
_LEAST_SHARE = 0.5
# No signal of a robot is known better than this part of its own size: keeps noise-free data from dividing by zero.
_FINEST = 1e-9


def residual_scale(residuals: Sequence[FloatArray], spread: FloatArray) -> FloatArray:
    """(p,) scale of each output's residuals (K, p), NaN where they do not count, from the median of their size.

    A robot that stands has quantised sensors that say exactly zero, so half of the residuals may be nothing: the scale
    is not taken below half of what their ninth decile gives. `spread` (p,) of the outputs keeps it from vanishing.
    """
    median, decile = np.nanquantile(np.abs(np.concatenate(residuals)), [0.5, 0.9], axis=0)
    return np.asarray(np.maximum.reduce([median / _MEDIAN, _LEAST_SHARE * decile / _NINE_TENTHS, _FINEST * spread]))


def output_spread(stretches: Sequence[Stretch]) -> FloatArray:
    """(p,) standard deviation of each output; raises ValueError where one never changes."""
    spread = []
    for row in range(stretches[0].outputs.shape[1]):
        spread.append(np.std(np.concatenate([s.outputs[s.counts[:, row], row] for s in stretches])))
    if min(spread) == 0.0:
        raise ValueError("the outputs never change: is the sensor connected, and did the robot move?")
    return np.array(spread)


def huber_weight(scaled: FloatArray) -> FloatArray:
    """Weights of residuals over their scale, any shape: 1 inside `HUBER`, falling outside."""
    return np.asarray(HUBER / np.maximum(np.abs(scaled), HUBER))


def huber_loss(scaled: FloatArray) -> FloatArray:
    """The loss that these weights belong to: z^2 inside `HUBER`, a straight line outside; any shape."""
    size = np.abs(scaled)
    return np.asarray(np.where(size < HUBER, size**2, 2 * HUBER * size - HUBER**2))
