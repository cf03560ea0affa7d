"""Whether the robot clips a command, and at which level."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from diffdrive_mpc.models.identification.output_error.solve import OutputErrorFit, estimate
from diffdrive_mpc.models.identification.output_error.stretch import Stretch
from diffdrive_mpc.models.identification.settings import load_settings

_CERTAIN = 2.0
# Only the level and the gain have to move before the best level shows.
_TRIAL = 6


def find_limits(fit: OutputErrorFit, stretches: Sequence[Stretch], channel: int, robust: bool = True) -> OutputErrorFit:
    """Let input `channel` have a limit, and keep it if the data clearly show one.

    The weighted loss has to fall by more than the information criterion (Schwarz, Annals of Statistics 1978, 6(2)) asks
    for, counted in effective samples; enough commands have to lie beyond the level; and the level has to lie below the
    largest command by two standard deviations.

    Parameters
    ----------
    fit
        The fit without a limit on this input.
    stretches
        The data behind it.
    channel
        Number of the input.
    robust
        As for the fit.
    """
    settings = load_settings().saturation
    size = np.concatenate([np.abs(stretch.inputs[:, channel]) for stretch in stretches])
    levels = np.linspace(settings.lowest, 1.0, settings.levels, endpoint=False) * size.max()
    levels = levels[[np.mean(size > level) > settings.share for level in levels]]
    limited = tuple(free or j == channel for j, free in enumerate(fit.layout.limited))
    layout = replace(fit.layout, limited=limited)
    place = sum(fit.layout.counts[:3]) + sum(limited[:channel])
    candidates = [(layout, np.insert(fit.parameters, place, level)) for level in levels]
    if not candidates:
        return fit
    found = estimate(candidates, stretches, robust, _TRIAL)
    level, deviation = found.parameters[place], np.sqrt(found.covariance[place, place])
    samples = float(fit.effective_samples.sum())
    gain = samples * np.log(fit.loss(fit.scale).sum() / found.loss(fit.scale).sum()) - np.log(samples)
    beyond = float(np.mean(size > level))
    shown = gain > settings.evidence and beyond > settings.share and level + _CERTAIN * deviation < size.max()
    return found if shown else fit
