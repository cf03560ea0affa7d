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

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.output_error.experiment import SampledExperiment, joined
from diffdrive_mpc.models.output_error.held_out import HeldOut, hold_out
from diffdrive_mpc.models.output_error.input_limits import KINDS, taken
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
    return _confirmed(best, drives, robust)


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
    """Yield limits (4,) with one side more, or with both rates."""
    settings = estimator_settings().limits
    parts = np.geomspace(settings.lowest, 1.0, settings.levels, endpoint=False)
    rates = largest.max() / np.geomspace(*settings.durations, settings.levels)
    levels = [([kind], parts * largest[kind]) for kind in (0, 1)]
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
    samples = float(fit.effective_samples.sum())
    return float(samples * np.log(before / after) - more * np.log(samples))


def _evidence(plain: OutputErrorFit, more: OutputErrorFit) -> float:
    before, after = (float(fit.loss(plain.scale).sum()) for fit in (plain, more))
    return _criterion(plain, before, after, len(more.parameters) - len(plain.parameters))


def _confirmed(fit: OutputErrorFit, drives: _Drives, robust: bool) -> OutputErrorFit:
    """Return the fit with the limits that are certain and predict held-out blocks better, deviations widened."""
    settings, blocks = estimator_settings().limits, _held_out(fit, drives, robust)
    for kind in np.flatnonzero(np.isfinite(limits_of(fit))).tolist():
        free = np.isfinite(limits_of(fit)) & (np.arange(len(KINDS)) != kind)
        place = fit.layout.names.index(f"{KINDS[kind]}_0")
        start = replace(fit.layout, limited=(tuple(free.tolist()),)), np.delete(fit.parameters, place)
        plain = fit_output_error([start], drives.experiments, robust, brief=True)
        shown = _is_certain(fit, kind, place, drives) and _evidence(plain, fit) > settings.evidence
        if shown and blocks is not None and (without := _held_out(plain, drives, robust)) is not None:
            fall = np.log(without.powers.sum(axis=0) / blocks.powers.sum(axis=0))
            shown = plain.effective_samples @ fall > settings.held_out_evidence
        if not shown:
            fit, blocks = plain, _held_out(plain, drives, robust)
    if blocks is None:
        return fit
    # Few commands are beyond a limit, so its deviation is not taken below that between blocks.
    wider, limits = np.ones(len(fit.parameters)), slice(sum(fit.layout.counts[:3]), None)
    wider[limits] = np.maximum(1.0, blocks.deviation[limits] / np.sqrt(np.diag(fit.covariance)[limits]))
    return replace(fit, covariance=fit.covariance * np.outer(wider, wider))


def _held_out(fit: OutputErrorFit, drives: _Drives, robust: bool) -> HeldOut | None:
    """Return models like the fit without each block; None without limits, or if the records are too short."""
    try:
        return hold_out(fit, joined(drives.experiments), robust, brief=True) if sum(fit.layout.counts[3:]) else None
    except ValueError:
        return None


def _is_certain(fit: OutputErrorFit, kind: int, place: int, drives: _Drives) -> bool:
    value, deviation = fit.parameters[place], np.sqrt(fit.covariance[place, place])
    without = np.where(np.arange(len(KINDS)) == kind, np.inf, limits_of(fit))
    if _share(drives.limited(fit, limits_of(fit)), drives.limited(fit, without)) < estimator_settings().limits.share:
        return False
    if kind < _RATES:
        return bool(value + _CERTAIN * deviation < drives.largest[kind])
    return bool(value > _CERTAIN * deviation)
