"""Search for the limits of a base in one channel: maximum commands and rates, separately for each side.

For each candidate, the commands are limited, and linear models estimate the cost. To the best candidates the layout
without limits is fitted for a few evaluations. The best of these is refined together with all parameters. A limit is
accepted if it improves the information criterion (Schwarz, Annals of Statistics 1978, 6(2)) and the prediction of
held-out blocks.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from operator import itemgetter
from typing import NamedTuple

import numpy as np
from threadpoolctl import threadpool_limits

from diffdrive_mpc.models.base_effects import KINDS
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.output_error.experiment import SampledExperiment, join_experiments
from diffdrive_mpc.models.output_error.held_out import HeldOut, hold_out
from diffdrive_mpc.models.output_error.input_limits import limited_inputs
from diffdrive_mpc.models.output_error.parameters import Layout
from diffdrive_mpc.models.output_error.settings import estimator_settings
from diffdrive_mpc.models.output_error.solve import FitData, OutputErrorFit, brief_cost, fit_output_error, weighted_data

_RATES = 2
"""Index of the first kind of limit that is a rate."""
# Minimum distance of a limit below the maximum command, and of a rate above zero [standard deviations].
_SIGNIFICANCE = 2.0


def find_limits(
    fit: OutputErrorFit, experiments: Sequence[SampledExperiment], quick: FloatArray, robust: bool = True
) -> OutputErrorFit:
    """Add the limits of the single input that the data indicate.

    Parameters
    ----------
    fit
        The fit without limits.
    experiments
        The data of the fit.
    quick
        (q,) parameters of a fast robot, a second initial guess of the candidates, because a ramp can appear as a lag.
    robust
        Option of `fit_output_error`.
    """
    settings, drives = estimator_settings().limits, _Drives(experiments)
    best = fit
    # One limit is added per round, because each candidate is assessed together with the limits of earlier rounds.
    while True:
        trial = _with_best_candidate(best, drives, quick, robust)
        if trial is None or _evidence(best, trial) < settings.evidence:
            break
        best = trial
    return fit if best is fit else _confirm_limits(best, fit, drives, robust)


class _Drives(NamedTuple):
    """Data of one channel."""

    experiments: Sequence[SampledExperiment]

    def limited(self, fit: OutputErrorFit, limit: FloatArray) -> list[SampledExperiment]:
        """Return the joined experiments with limited inputs, starting from the steady state of `fit`."""
        system = fit.system._replace(limit=limit[None])
        return [replace(e, inputs=limited_inputs(system, e)) for e in join_experiments(self.experiments)]

    @property
    def max_inputs(self) -> FloatArray:
        """(2,) maximum magnitude of positive and of negative inputs."""
        inputs = np.concatenate([experiment.inputs for experiment in self.experiments])
        return np.maximum([inputs.max(), -inputs.min()], 0.0)


def limits_of(fit: OutputErrorFit) -> FloatArray:
    """Return the limits (4,) of the single input."""
    return np.asarray(fit.system.limit[0])


def _share(limited: Sequence[SampledExperiment], without: Sequence[SampledExperiment]) -> float:
    """Return the share of the samples that a limit changes."""
    pairs = zip(limited, without, strict=True)
    return float(np.mean(np.concatenate([a.inputs != b.inputs for a, b in pairs])))


def _candidates(limit: FloatArray, max_inputs: FloatArray) -> Iterator[FloatArray]:
    """Yield limits (4,) with an additional limit of one side, or of both sides."""
    settings = estimator_settings().limits
    shares, rates = np.array(settings.levels), max_inputs.max() / np.array(settings.durations)
    levels = [(kinds, shares * max_inputs[kinds].max()) for kinds in ([0], [1], [0, 1])]
    for kinds, values in (*levels, ([2], rates), ([3], rates), ([2, 3], rates)):
        if values.max() > 0 and np.isinf(limit[kinds]).all():
            for value in values:
                yield np.where(np.isin(np.arange(len(KINDS)), kinds), value, limit)


def _with_best_candidate(
    best: OutputErrorFit, drives: _Drives, quick: FloatArray, robust: bool
) -> OutputErrorFit | None:
    """Return the fit with the best candidate; None if no candidate improves the criterion."""
    settings, limit = estimator_settings().limits, limits_of(best)
    unlimited, data = replace(best.layout, limited=()), weighted_data(drives.limited(best, limit), best)
    # Limits are the last parameters. The search omits them, because the inputs of candidates are already limited.
    starts, estimates, scored = [best.parameters[: len(quick)], quick], [], []
    with threadpool_limits(1):
        before, _ = brief_cost(unlimited, starts[:1], data)
        bases = [np.linalg.qr(data.problem(unlimited, start).jacobian(start))[0] for start in starts]
        for candidate in _candidates(limit, drives.max_inputs):
            limited = data._replace(experiments=drives.limited(best, candidate))
            if _share(limited.experiments, data.experiments) > settings.share:
                added = int(np.sum(candidate != limit))
                cost = min(_linear_cost(limited, unlimited, *pair) for pair in zip(starts, bases, strict=True))
                estimates.append((_criterion(best, before, cost, added), candidate, added))
        for _, candidate, added in sorted(estimates, key=itemgetter(0), reverse=True)[: settings.fitted]:
            limited = data._replace(experiments=drives.limited(best, candidate))
            cost, parameters = brief_cost(unlimited, starts, limited)
            scored.append((_criterion(best, before, cost, added), candidate, parameters))
    if not scored or (best_entry := max(scored, key=itemgetter(0)))[0] < 0.0:
        return None
    _, candidate, parameters = best_entry
    free = np.isfinite(candidate)
    layout = replace(best.layout, limited=(tuple(free.tolist()),))
    return fit_output_error([(layout, np.concatenate([parameters, candidate[free]]))], drives.experiments, robust)


def _linear_cost(data: FitData, layout: Layout, start: FloatArray, basis: FloatArray) -> float:
    """Return the minimum cost of a linear model at the parameters `start` (q,).

    Its derivatives span the columns of `basis` (rows, q), so the cost needs one simulation. Derivatives for similar
    inputs are sufficient to rank candidates.
    """
    residuals = data.problem(layout, start).residuals(start)
    return 0.5 * float(residuals @ residuals - np.sum((residuals @ basis) ** 2))


def _criterion(fit: OutputErrorFit, before: float, after: float, added: int) -> float:
    """Return the decrease of the information criterion from loss `before` to loss `after` with `added` parameters."""
    samples = float(fit.sandwich.effective_samples.sum())
    return float(samples * np.log(before / after) - added * np.log(samples))


def _evidence(smaller: OutputErrorFit, larger: OutputErrorFit) -> float:
    before, after = (float(fit.loss(smaller.scale).sum()) for fit in (smaller, larger))
    return _criterion(smaller, before, after, len(larger.parameters) - len(smaller.parameters))


class _Removal(NamedTuple):
    """Result of the removal of some limits.

    Attributes
    ----------
    fit
        Fit without these limits.
    blocks
        Fits of its layout without each block; None if the records are too short.
    is_worse
        True if the data support the limits.
    """

    fit: OutputErrorFit
    blocks: HeldOut | None
    is_worse: bool


def _remove_limits(
    fit: OutputErrorFit, blocks: HeldOut | None, kinds: Sequence[int], drives: _Drives, robust: bool
) -> _Removal:
    """Remove the limits `kinds` from a fit; `blocks` are fits of its layout without each block."""
    # `first` is the index of the first limit in the parameters, after parametrisation, dead times and offsets.
    settings, limit, first = estimator_settings().limits, limits_of(fit), sum(fit.layout.counts[:3])
    free = np.isfinite(limit) & ~np.isin(np.arange(len(KINDS)), kinds)
    start = np.concatenate([fit.parameters[:first], limit[free]])
    layout = replace(fit.layout, limited=(tuple(free.tolist()),))
    plain = fit_output_error([(layout, start)], drives.experiments, robust, brief=True)
    without = _hold_out(plain, drives, robust)
    evidence = _evidence(plain, fit)
    is_worse = all(_is_significant(fit, kind, drives) for kind in kinds) and evidence > settings.evidence
    if is_worse and blocks is not None and without is not None:
        # If a limit is reached in one block only, the fit without this block cannot determine it. Strong evidence from
        # all data is therefore sufficient if held-out blocks do not contradict it.
        required = 0.0 if evidence > settings.strong_evidence else settings.held_out_evidence
        decrease = np.log(without.powers.sum(axis=0) / blocks.powers.sum(axis=0))
        is_worse = bool(plain.sandwich.effective_samples @ decrease > required)
    return _Removal(plain, without, is_worse)


def _confirm_limits(best: OutputErrorFit, free: OutputErrorFit, drives: _Drives, robust: bool) -> OutputErrorFit:
    """Return the fit with only those limits that are significant and improve held-out blocks.

    Each side is tested separately. If one side is not significant, both sides are tested together. Deviations of the
    limits are increased to the scatter between blocks. If no limit remains, the result is `free`.
    """
    fit, blocks = best, _hold_out(best, drives, robust)
    for pair in ([0, 1], [2, 3]):
        sides = [kind for kind in pair if np.isfinite(limits_of(fit)[kind])]
        both, removals = fit, {kind: _remove_limits(fit, blocks, [kind], drives, robust) for kind in sides}
        weak = [kind for kind in sides if not removals[kind].is_worse]
        if sides == pair and weak and _remove_limits(fit, blocks, pair, drives, robust).is_worse:
            continue
        for kind in weak:
            removal = removals[kind] if fit is both else _remove_limits(fit, blocks, [kind], drives, robust)
            if not removal.is_worse:
                fit, blocks = removal.fit, removal.blocks
    first = sum(fit.layout.counts[:3])
    if first == len(fit.parameters):
        return free
    # Fits of removals were brief, so complete the last one.
    if fit is not best:
        fit = fit_output_error([(fit.layout, fit.parameters)], drives.experiments, robust)
    # Few commands exceed a limit, so its deviation is at least the deviation between blocks.
    factors = np.ones(len(fit.parameters))
    if blocks is not None:
        factors[first:] = np.maximum(1.0, blocks.deviation[first:] / fit.estimate.standard_deviation[first:])
    return replace(fit, sandwich=fit.sandwich.derived(np.diag(factors)))


def _hold_out(fit: OutputErrorFit, drives: _Drives, robust: bool) -> HeldOut | None:
    """Return fits of the same layout without each block; None if the records are too short."""
    try:
        return hold_out(fit, join_experiments(drives.experiments), robust, brief=True)
    except ValueError:
        return None


def _is_significant(fit: OutputErrorFit, kind: int, drives: _Drives) -> bool:
    index = fit.layout.names.index(f"{KINDS[kind]}_0")
    value, deviation = fit.parameters[index], fit.estimate.standard_deviation[index]
    without = np.where(np.arange(len(KINDS)) == kind, np.inf, limits_of(fit))
    if _share(drives.limited(fit, limits_of(fit)), drives.limited(fit, without)) < estimator_settings().limits.share:
        return False
    if kind < _RATES:
        return bool(value + _SIGNIFICANCE * deviation < drives.max_inputs[kind])
    return bool(value > _SIGNIFICANCE * deviation)
