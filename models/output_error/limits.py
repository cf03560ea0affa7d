"""Search for the limits of a base in one channel: largest commands and rates, each side on its own.

A candidate limits the commands first; the plain layout is then fitted to them for a few evaluations. The best candidate
is refined together with all parameters. A side stays if the information criterion (Schwarz, Annals of Statistics 1978,
6(2)) and the prediction of held-out blocks ask for it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from threadpoolctl import threadpool_limits

from diffdrive_mpc.models.base_effects import KINDS
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.output_error.experiment import SampledExperiment, joined
from diffdrive_mpc.models.output_error.held_out import HeldOut, hold_out
from diffdrive_mpc.models.output_error.input_limits import taken
from diffdrive_mpc.models.output_error.settings import estimator_settings
from diffdrive_mpc.models.output_error.solve import OutputErrorFit, brief_cost, fit_output_error

_RATES = 2
"""Kinds from this one on are rates."""
# A limit has to be so many standard deviations below what was commanded, and a rate above zero.
_CERTAIN = 2.0


def find_limits(
    fit: OutputErrorFit, experiments: Sequence[SampledExperiment], quick: FloatArray, robust: bool = True
) -> OutputErrorFit:
    """Add the limits of the one input that the data show.

    Parameters
    ----------
    fit
        The fit without limits.
    experiments
        The data behind it.
    quick
        (q,) first guess of a robot that is not slow, from which candidates are fitted, too: a ramp passes for a lag.
    robust
        As for the fit.
    """
    settings, drives = estimator_settings().limits, _Drives(experiments)
    best = fit
    while True:
        trial = _extended(best, drives, quick, robust)
        if trial is None or _evidence(best, trial) < settings.evidence:
            break
        best = trial
    return fit if best is fit else _confirmed(best, fit, drives, robust)


class _Drives(NamedTuple):
    """The data of one channel."""

    experiments: Sequence[SampledExperiment]

    def limited(self, fit: OutputErrorFit, limit: FloatArray) -> list[SampledExperiment]:
        """Return the same, joined, with inputs that are limited already, from where `fit` begins."""
        system = fit.system._replace(limit=limit[None])
        return [replace(e, inputs=taken(system, e)) for e in joined(self.experiments)]

    @property
    def largest(self) -> FloatArray:
        """(2,) largest input above and below zero."""
        inputs = np.concatenate([experiment.inputs for experiment in self.experiments])
        return np.maximum([inputs.max(), -inputs.min()], 0.0)


def limits_of(fit: OutputErrorFit) -> FloatArray:
    """Return the limits (4,) of the one input."""
    return np.asarray(fit.system.limit[0])


def _share(limited: Sequence[SampledExperiment], without: Sequence[SampledExperiment]) -> float:
    """Return the share of the samples that a limit changes."""
    pairs = zip(limited, without, strict=True)
    return float(np.mean(np.concatenate([a.inputs != b.inputs for a, b in pairs])))


def _candidates(limit: FloatArray, largest: FloatArray) -> Iterator[FloatArray]:
    """Yield limits (4,) with one side more, or with both."""
    settings = estimator_settings().limits
    parts, rates = np.array(settings.levels), largest.max() / np.array(settings.durations)
    levels = [(kinds, parts * largest[kinds].max()) for kinds in ([0], [1], [0, 1])]
    for kinds, values in (*levels, ([2], rates), ([3], rates), ([2, 3], rates)):
        if values.max() > 0 and np.isinf(limit[kinds]).all():
            for value in values:
                yield np.where(np.isin(np.arange(len(KINDS)), kinds), value, limit)


def _extended(best: OutputErrorFit, drives: _Drives, quick: FloatArray, robust: bool) -> OutputErrorFit | None:
    """Return the fit with the candidate that explains most; None if none explains more."""
    limit, least = limits_of(best), estimator_settings().limits.share
    plain, current = replace(best.layout, limited=()), drives.limited(best, limit)
    starts = [best.parameters[: len(quick)], quick]
    scored = []
    with threadpool_limits(1):
        before, _ = brief_cost(plain, starts[:1], current, best)
        for candidate in _candidates(limit, drives.largest):
            experiments = drives.limited(best, candidate)
            if _share(experiments, current) > least:
                cost, parameters = brief_cost(plain, starts, experiments, best)
                scored.append((_criterion(best, before, cost, int(np.sum(candidate != limit))), candidate, parameters))
    if not scored or (chosen := max(scored, key=lambda entry: entry[0]))[0] < 0.0:
        return None
    _, candidate, parameters = chosen
    free = np.isfinite(candidate)
    layout = replace(best.layout, limited=(tuple(free.tolist()),))
    return fit_output_error([(layout, np.concatenate([parameters, candidate[free]]))], drives.experiments, robust)


def _criterion(fit: OutputErrorFit, before: float, after: float, more: int) -> float:
    """Return the fall of the information criterion from one loss to another, with `more` parameters."""
    samples = float(fit.sandwich.effective_samples.sum())
    return float(samples * np.log(before / after) - more * np.log(samples))


def _evidence(plain: OutputErrorFit, more: OutputErrorFit) -> float:
    before, after = (float(fit.loss(plain.scale).sum()) for fit in (plain, more))
    return _criterion(plain, before, after, len(more.parameters) - len(plain.parameters))


class _Removal(NamedTuple):
    """The fit without some limits, models like it without each block, and whether the data ask for these limits."""

    fit: OutputErrorFit
    blocks: HeldOut | None
    is_worse: bool


def _removed(
    fit: OutputErrorFit, blocks: HeldOut | None, kinds: Sequence[int], drives: _Drives, robust: bool
) -> _Removal:
    """Remove the limits of some kinds from a fit; `blocks` are models like it without each block."""
    settings, limit, first = estimator_settings().limits, limits_of(fit), sum(fit.layout.counts[:3])
    free = np.isfinite(limit) & ~np.isin(np.arange(len(KINDS)), kinds)
    start = np.concatenate([fit.parameters[:first], limit[free]])
    layout = replace(fit.layout, limited=(tuple(free.tolist()),))
    plain = fit_output_error([(layout, start)], drives.experiments, robust, brief=True)
    without = _held_out(plain, drives, robust)
    evidence = _evidence(plain, fit)
    is_worse = all(_is_certain(fit, kind, drives) for kind in kinds) and evidence > settings.evidence
    if is_worse and blocks is not None and without is not None:
        # A limit that is reached in one block only is unknown to the model without this block.
        required = 0.0 if evidence > settings.strong_evidence else settings.held_out_evidence
        fall = np.log(without.powers.sum(axis=0) / blocks.powers.sum(axis=0))
        is_worse = bool(plain.sandwich.effective_samples @ fall > required)
    return _Removal(plain, without, is_worse)


def _confirmed(best: OutputErrorFit, free: OutputErrorFit, drives: _Drives, robust: bool) -> OutputErrorFit:
    """Return the fit with the limits that are certain and predict held-out blocks better, deviations widened.

    Each side is judged alone; where a side alone is not shown, both may be together. Without any limit it is `free`.
    """
    fit, blocks = best, _held_out(best, drives, robust)
    for pair in ([0, 1], [2, 3]):
        sides = [kind for kind in pair if np.isfinite(limits_of(fit)[kind])]
        both, removals = fit, {kind: _removed(fit, blocks, [kind], drives, robust) for kind in sides}
        weak = [kind for kind in sides if not removals[kind].is_worse]
        if sides == pair and weak and _removed(fit, blocks, pair, drives, robust).is_worse:
            continue
        for kind in weak:
            removal = removals[kind] if fit is both else _removed(fit, blocks, [kind], drives, robust)
            if not removal.is_worse:
                fit, blocks = removal.fit, removal.blocks
    first = sum(fit.layout.counts[:3])
    if first == len(fit.parameters):
        return free
    if fit is not best:
        fit = fit_output_error([(fit.layout, fit.parameters)], drives.experiments, robust)
    # Few commands are beyond a limit, so its deviation is not taken below that between blocks.
    wider = np.ones(len(fit.parameters))
    if blocks is not None:
        wider[first:] = np.maximum(1.0, blocks.deviation[first:] / fit.estimate.standard_deviation[first:])
    return replace(fit, sandwich=fit.sandwich.derived(np.diag(wider)))


def _held_out(fit: OutputErrorFit, drives: _Drives, robust: bool) -> HeldOut | None:
    """Return models like the fit without each block; None if the records are too short."""
    try:
        return hold_out(fit, joined(drives.experiments), robust, brief=True)
    except ValueError:
        return None


def _is_certain(fit: OutputErrorFit, kind: int, drives: _Drives) -> bool:
    place = fit.layout.names.index(f"{KINDS[kind]}_0")
    value, deviation = fit.parameters[place], fit.estimate.standard_deviation[place]
    without = np.where(np.arange(len(KINDS)) == kind, np.inf, limits_of(fit))
    if _share(drives.limited(fit, limits_of(fit)), drives.limited(fit, without)) < estimator_settings().limits.share:
        return False
    if kind < _RATES:
        return bool(value + _CERTAIN * deviation < drives.largest[kind])
    return bool(value > _CERTAIN * deviation)
