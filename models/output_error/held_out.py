"""Blocks of the records held out in turn: what a model predicts of them that was made without them."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.output_error.experiment import Experiment, joined
from diffdrive_mpc.models.output_error.settings import estimator_settings
from diffdrive_mpc.models.output_error.solve import OutputErrorFit, fit_output_error
from diffdrive_mpc.models.output_error.validation import simulate_experiment

Pieces = list[tuple[int, int, int]]
"""Number of an experiment, its samples from and up to."""


def blocks(experiments: Sequence[Experiment]) -> list[tuple[Pieces, Pieces]]:
    """For each part of equal length, in the order of time: the data without it, and it; short rests are left out.

    Raises
    ------
    ValueError
        If the experiments are too short for it.
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
            a, b = np.clip([low - end + count, high - end + count], 0, count).tolist()
            for first, stop, into in ((0, a, rest), (a, b, block), (b, count, rest)):
                if (experiment.counts[first:stop].sum(axis=0) >= settings.fewest_readings).all():
                    into.append((i, first, stop))
        if not (rest and block):
            raise ValueError(
                f"the records are too short to hold any of {settings.blocks} blocks out; give a longer log"
            )
        folds.append((rest, block))
    return folds


def cut(experiments: Sequence[Experiment], pieces: Pieces) -> list[Experiment]:
    """Some of the data."""
    found = []
    for i, first, stop in pieces:
        whole, rows = experiments[i], slice(first, stop)
        found.append(Experiment(whole.name, whole.dt, whole.inputs[rows], whole.outputs[rows], whole.counts[rows]))
    return found


def held_out_powers(fit: OutputErrorFit, experiments: Sequence[Experiment], robust: bool = True) -> FloatArray:
    """(blocks, p) mean square error of each output in each block, by a model like `fit` made without that block.

    Raises
    ------
    ValueError
        As `blocks`; or if an output never changes without some block.
    """
    powers = []
    for rest, block in blocks(experiments):
        found = fit_output_error([(fit.layout, fit.parameters)], cut(experiments, rest), robust, scale=fit.scale)
        errors = [
            np.where(one.counts, one.outputs - simulate_experiment(found.system, one), np.nan)
            for one in cut(experiments, block)
        ]
        powers.append(np.nanmean(np.concatenate(errors) ** 2, axis=0))
    return np.array(powers)


def predicts_better(
    new: OutputErrorFit, old: OutputErrorFit, experiments: Sequence[Experiment], robust: bool = True
) -> bool:
    """Whether models like `new` predict the blocks they were made without better than ones like `old`.

    Records too short for that decide nothing: then True.
    """
    experiments = joined(experiments)
    try:
        blocks(experiments)
    except ValueError:
        return True
    one, other = (held_out_powers(fit, experiments, robust).sum(axis=0) for fit in (new, old))
    return bool(np.log(one / other).sum() < 0.0)
