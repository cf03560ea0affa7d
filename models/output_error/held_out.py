"""Cross-validation on blocks of the records."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.output_error.experiment import SampledExperiment, split_rows
from diffdrive_mpc.models.output_error.settings import estimator_settings
from diffdrive_mpc.models.output_error.solve import OutputErrorFit, fit_output_error
from diffdrive_mpc.models.output_error.validation import simulate_experiment

# The optimum without a block is close to the optimum with it, so few evaluations suffice if the weights are fixed.
_FIXED_EVALUATIONS = 5

Pieces = list[tuple[int, int, int]]
"""Pieces of data: index of the experiment, first sample, and end (exclusive)."""


def blocks(experiments: Sequence[SampledExperiment]) -> list[tuple[Pieces, Pieces]]:
    """Return the remaining data and the held-out data of each block in order of time, without short parts.

    Raises
    ------
    ValueError
        If the experiments are too short.
    """
    settings = estimator_settings().held_out
    ends = np.cumsum([experiment.samples for experiment in experiments])
    edges = np.linspace(0, ends[-1], settings.blocks + 1).astype(int)
    folds = []
    for low, high in pairwise(edges):
        rest: Pieces = []
        block: Pieces = []
        for i, (experiment, end) in enumerate(zip(experiments, ends, strict=True)):
            count = experiment.samples
            start, end_of_block = np.clip([low - end + count, high - end + count], 0, count).tolist()
            for first, stop, pieces in ((0, start, rest), (start, end_of_block, block), (end_of_block, count, rest)):
                if (experiment.counts[first:stop].sum(axis=0) >= settings.min_readings).all():
                    pieces.append((i, first, stop))
        if not (rest and block):
            raise ValueError(f"the records are too short for {settings.blocks} held-out blocks; give a longer log")
        folds.append((rest, block))
    return folds


def extract(experiments: Sequence[SampledExperiment], pieces: Pieces) -> list[SampledExperiment]:
    """Extract the pieces of the data as separate experiments."""
    parts = []
    for i, first, stop in pieces:
        source, rows = experiments[i], slice(first, stop)
        parts.append(
            SampledExperiment(source.name, source.dt, source.inputs[rows], source.outputs[rows], source.counts[rows])
        )
    return parts


class HeldOut(NamedTuple):
    """Results of fits without each block: errors on the held-out block, and parameters."""

    powers: FloatArray
    """(blocks, p) mean square error of each output in each block."""
    parameters: FloatArray
    """(blocks, q) parameters of each fit."""

    @property
    def deviation(self) -> FloatArray:
        """(q,) standard deviation of the parameters by the block jackknife.

        Student's t distribution corrects for the small number of blocks.
        """
        from scipy import stats  # noqa: PLC0415 - slow import, not needed to load a model

        count = len(self.parameters)
        # The jackknife variance is the sum of squared deviations times (n - 1) / n.
        scatter = np.sqrt((count - 1) ** 2 / count * self.parameters.var(axis=0, ddof=1))
        return np.asarray(scatter * stats.t.ppf(0.975, count - 1) / stats.norm.ppf(0.975))


def hold_out(
    fit: OutputErrorFit,
    experiments: Sequence[SampledExperiment],
    robust: bool = True,
    *,
    brief: bool = False,
    fixed_weights: bool = False,
) -> HeldOut:
    """Repeat `fit` without each block; `robust` and `brief` are options of `fit_output_error`.

    With `fixed_weights`, the weights of the readings are those in `fit`.

    Raises
    ------
    ValueError
        If the experiments are too short, or an output is constant outside of a block.
    """
    powers, parameters = [], []
    start, weights = [(fit.layout, fit.parameters)], split_rows(fit.trust, experiments)
    for rest, block in blocks(experiments):
        trust = [weights[i][first:stop] for i, first, stop in rest] if fixed_weights else None
        evaluations = _FIXED_EVALUATIONS if fixed_weights else None
        refit = fit_output_error(start, extract(experiments, rest), robust, brief, fit.scale, trust, evaluations)
        errors = [part.readings - simulate_experiment(refit.system, part) for part in extract(experiments, block)]
        powers.append(np.nanmean(np.concatenate(errors) ** 2, axis=0))
        parameters.append(refit.parameters)
    return HeldOut(np.array(powers), np.array(parameters))
