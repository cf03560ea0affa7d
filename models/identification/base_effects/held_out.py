"""How well a set of effects predicts parts of the records that it was not estimated from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from diffdrive_mpc.models.identification.base_effects.fitting import EffectFit, Weighted, fit_effects
from diffdrive_mpc.models.identification.base_effects.free_run import Point
from diffdrive_mpc.models.identification.base_effects.settings import effect_settings
from diffdrive_mpc.models.identification.output_error.stretch import Stretch
from diffdrive_mpc.models.interface import FloatArray

Pieces = list[tuple[int, int, int]]
"""Number of a stretch, its samples from and up to."""


@dataclass(frozen=True)
class Tried:
    """A fit to all data, and the same model without each block.

    Attributes
    ----------
    fit
        From all data.
    points
        The parameters found without each block.
    """

    fit: EffectFit
    points: tuple[Point, ...]


def tried(fit: EffectFit, data: Weighted) -> Tried:
    """Search anew, from `fit`, without each block in turn."""
    trial = effect_settings().trial
    folds = blocks(data.stretches)
    fits = [fit_effects(fit.point, fit.free, data.part(rest), trial, near=True) for rest, _ in folds]
    return Tried(fit, tuple(found.point for found in fits))


def gain(old: Tried, new: Tried, data: Weighted) -> tuple[float, int]:
    """Fall of the logarithm of the held-out error power from `old` to `new`, mean over sensors; in how many blocks."""
    powers = np.array([_powers(model, data) for model in (old, new)])
    by_block = np.log(powers).mean(axis=2)
    whole = np.log(powers.sum(axis=1)).mean(axis=1)
    return float(whole[0] - whole[1]), int(np.sum(by_block[0] > by_block[1]))


def blocks(stretches: Sequence[Stretch]) -> list[tuple[Pieces, Pieces]]:
    """For each part of equal length, in the order of time: the data without it, and it; short rests are left out."""
    settings = effect_settings()
    ends = np.cumsum([stretch.samples for stretch in stretches])
    edges = np.linspace(0, ends[-1], settings.blocks + 1).astype(int)
    folds = []
    for low, high in pairwise(edges):
        rest: Pieces = []
        block: Pieces = []
        for i, (stretch, end) in enumerate(zip(stretches, ends, strict=True)):
            count = stretch.samples
            a, b = np.clip([low - end + count, high - end + count], 0, count).tolist()
            for first, stop, into in ((0, a, rest), (a, b, block), (b, count, rest)):
                if (stretch.counts[first:stop].sum(axis=0) >= settings.fewest_readings).all():
                    into.append((i, first, stop))
        if not (rest and block):
            raise ValueError(
                f"the records are too short to hold any of {settings.blocks} blocks out; give a longer log"
            )
        folds.append((rest, block))
    return folds


def _powers(model: Tried, data: Weighted) -> FloatArray:
    """(blocks, 3) sum of the squared weighted errors of each sensor in each block, by the model found without it."""
    parts = [data.part(block) for _, block in blocks(data.stretches)]
    return np.array(
        [
            np.sum([np.nansum(error**2, axis=0) for error in part.errors(point)], axis=0)
            for part, point in zip(parts, model.points, strict=True)
        ]
    )
