"""Output error: measured outputs minus a simulation from the inputs alone, and its derivatives.

Each experiment has a past of its own: a command before it, in whose settled state the robot was, and a deviation from
that state, which a prior keeps small (else it would explain the transient, and dynamics and dead time would not be seen
where stretches begin at a step). Both enter linearly, so they are solved for exactly inside every evaluation and
projected out of the derivatives (variable projection, Golub and Pereyra 1973, with Kaufman's 1975 simplification, whose
gradient is exact): any number of experiments costs no parameter.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import linalg

from diffdrive_mpc.models.interface import AnyArray, FloatArray
from diffdrive_mpc.models.output_error.experiment import SampledExperiment
from diffdrive_mpc.models.output_error.input_limits import slopes, taken
from diffdrive_mpc.models.output_error.parameters import Layout
from diffdrive_mpc.models.output_error.state_space import (
    LinearSystem,
    SampledSystem,
    StateResponse,
    delayed,
    sample,
)

# Any step this small is exact in complex arithmetic.
_COMPLEX_STEP = 1e-30
# Directions of the past that the outputs show less than this, relative to the best seen, are left at zero.
_SEEN = 1e-9
# Directions of the state that the commands move less than this, relative to the one moved most, count as moved so much.
_MOVED = 1e-4
# What is left of an initial state counts no more once its slowest part has decayed to this.
_DECAYED = 1e-12


_Drive = tuple[FloatArray, FloatArray]
"""Limited inputs as B0 and B1 see them (m, K)."""


class _Model(NamedTuple):
    """A system sampled at one rate, with the quantities shared by all experiments of that rate."""

    system: LinearSystem
    sampled: SampledSystem
    respond: StateResponse
    hold: FloatArray
    """(n, m) settled states of unit inputs"""
    past: FloatArray
    """(n, m + n, E) states from each unit command before, and each unit deviation, until they have decayed."""


class _Past(NamedTuple):
    """Effect of the unknown past on the first E samples; r directions."""

    outputs: FloatArray
    """(E p, r) output rows of an orthonormal basis of the effect of pasts on the outputs and on their prior"""
    prior: FloatArray
    """(m + n, r) prior rows of this basis"""
    recover: FloatArray
    """(m + n, r) from components along the basis to the command before and the deviation"""


class OutputErrorProblem:
    """Weighted residuals of several experiments as functions of the parameters of a layout.

    Parameters
    ----------
    layout
        Which parameters there are.
    experiments
        The data.
    weights
        For each experiment (K, p) factors of the residuals, not negative; zero where a sample does not count.
    prior
        For each experiment (m + n, m + n) one over the standard deviation of its past, the command before it first: the
        past's part of the residuals is this times it. See `past_prior`. By default all zero: any past will do.
    """

    def __init__(
        self,
        layout: Layout,
        experiments: Sequence[SampledExperiment],
        weights: Sequence[FloatArray],
        prior: Sequence[FloatArray] | None = None,
    ) -> None:
        self._layout, self._experiments, self._weights = layout, list(experiments), list(weights)
        self._rows = sum(weight.size for weight in weights)
        self._prior = [None] * len(weights) if prior is None else list(prior)
        self._longest = {experiment.dt: 0 for experiment in experiments}
        for experiment in experiments:
            self._longest[experiment.dt] = max(self._longest[experiment.dt], experiment.samples)

    def residuals(self, parameters: FloatArray) -> FloatArray:
        """Return (rows,) weighted residuals by experiment and sample, then of the pasts; infinite where unstable."""
        system = self._layout.system(parameters)
        if np.linalg.eigvals(system.A).real.max() >= 0:
            return np.full(self._rows + len(self._experiments) * (system.B.shape[1] + len(system.A)), np.inf)
        models = self._models(system)
        parts, pasts = [], []
        for experiment, weight, prior in zip(self._experiments, self._weights, self._prior, strict=True):
            model = models[experiment.dt]
            states = _forced(model, taken(system, experiment))
            error = (weight * (experiment.outputs - system.offset - states.T @ system.C.T)).ravel()
            pasts.append(_project(error, _past(model, weight, prior)))
            parts.append(error)
        return np.concatenate(parts + pasts)

    def jacobian(self, parameters: FloatArray) -> FloatArray:
        """Return the (rows, q) derivatives of `residuals`."""
        system = self._layout.system(parameters)
        models = self._models(system)
        slopes = {dt: self._derivatives(parameters, dt) for dt in models}
        parts, pasts = [], []
        for experiment, weight, prior in zip(self._experiments, self._weights, self._prior, strict=True):
            model = models[experiment.dt]
            rows, past = _experiment_jacobian(model, *slopes[experiment.dt], experiment, weight, prior)
            parts.append(rows)
            pasts.append(past)
        return np.concatenate(parts + pasts)

    def simulations(self, parameters: FloatArray) -> list[FloatArray]:
        """Simulate the outputs (K, p) of each experiment, sensor offset included, from the best past."""
        system = self._layout.system(parameters)
        models = self._models(system)
        return [
            _simulate(models[experiment.dt], experiment, weight, prior)[0].T @ system.C.T + system.offset
            for experiment, weight, prior in zip(self._experiments, self._weights, self._prior, strict=True)
        ]

    def _models(self, system: LinearSystem) -> dict[float, _Model]:
        """Sample the system at each sample time of the data."""
        n, slowest = len(system.A), np.linalg.eigvals(system.A).real.max()
        hold = -np.linalg.solve(system.A, system.B)
        models = {}
        for dt, longest in self._longest.items():
            sampled = sample(system, dt)
            respond = StateResponse(sampled.A)
            early = int(min(longest, n + 2 + sampled.delay.max() + np.log(_DECAYED) / (slowest * dt)))
            acting = np.arange(early)
            before = [
                sampled.B0[:, [j]] * (acting < delay) + sampled.B1[:, [j]] * (acting < delay + 1)
                for j, delay in enumerate(sampled.delay)
            ]
            drive = np.stack([*before, *np.zeros((n, n, early))], axis=1)
            models[dt] = _Model(system, sampled, respond, hold, respond(drive, np.hstack([hold, np.eye(n)])))
        return models

    def _derivatives(self, parameters: FloatArray, dt: float) -> tuple[LinearSystem, SampledSystem]:
        """Differentiate the continuous and the sampled system by each parameter, (q, ...)."""
        stepped = parameters + 1j * _COMPLEX_STEP * np.eye(len(parameters))
        systems = LinearSystem(*map(np.array, zip(*map(self._layout.system, stepped), strict=True)))
        sampled = sample(systems, dt)

        def slope(value: AnyArray) -> FloatArray:
            return np.asarray(value.imag / _COMPLEX_STEP)

        return LinearSystem(*map(slope, systems)), SampledSystem(
            slope(sampled.A), slope(sampled.B0), slope(sampled.B1), sampled.delay
        )


def _past(model: _Model, weight: FloatArray, prior: FloatArray | None) -> _Past:
    free = model.past[..., : len(weight)]
    count = free.shape[1]
    rows = weight[: free.shape[-1], :, None] * np.moveaxis(np.tensordot(model.system.C, free, 1), 2, 0)
    known = np.zeros((count, count)) if prior is None else prior
    left, values, right = np.linalg.svd(np.vstack([rows.reshape(-1, count), known]), full_matrices=False)
    keep = values > _SEEN * max(values[0], np.finfo(float).tiny)
    return _Past(left[:-count, keep], left[-count:, keep], right[keep].T / values[keep])


def _simulate(
    model: _Model, experiment: SampledExperiment, weight: FloatArray, prior: FloatArray | None
) -> tuple[FloatArray, _Drive, FloatArray, _Past]:
    """Return states (n, K) from the best past, their drive, the command before, and the effect of the past."""
    system, past = model.system, _past(model, weight, prior)
    inputs = taken(system, experiment)
    states = _forced(model, inputs)
    early = len(past.outputs) // experiment.outputs.shape[1]
    error = weight * (experiment.outputs - system.offset - states.T @ system.C.T)
    recovered = past.recover @ (past.outputs.T @ error[:early].ravel())
    states[:, :early] += np.tensordot(model.past[..., :early], recovered, (1, 0))
    before = recovered[: inputs.shape[1]]
    return states, delayed(inputs, model.sampled.delay, before), before, past


def _experiment_jacobian(
    model: _Model,
    slope: LinearSystem,
    sampled_slope: SampledSystem,
    experiment: SampledExperiment,
    weight: FloatArray,
    prior: FloatArray | None,
) -> tuple[FloatArray, FloatArray]:
    """Return (K p, q) derivatives of an experiment's weighted residuals, and (m + n, q) of its past's."""
    states, (recent, older), before, past = _simulate(model, experiment, weight, prior)
    forcing = sampled_slope.A @ states + sampled_slope.B0 @ recent + sampled_slope.B1 @ older
    if slope.limit.any():
        changes = taken(model.system, experiment, slopes)
        for rates, by in zip(np.moveaxis(slope.limit, -1, 0)[:, :, None, :], changes, strict=True):
            recent, older = delayed(by, model.sampled.delay, np.zeros(by.shape[1]))
            forcing += (model.sampled.B0 * rates) @ recent + (model.sampled.B1 * rates) @ older
    settled = np.asarray(-np.linalg.solve(model.system.A, ((slope.A @ model.hold + slope.B) @ before).T))
    sensitivity = model.respond(np.moveaxis(forcing, 0, 1), settled)
    change = np.tensordot(model.system.C, sensitivity, 1) + np.moveaxis(slope.C @ states, 0, 1)
    change += slope.offset.T[:, :, None]
    rows = -(weight[:, :, None] * np.moveaxis(change, 2, 0)).reshape(weight.size, -1)
    return rows, _project(rows, past)


def past_prior(system: LinearSystem, experiments: Sequence[SampledExperiment], deviation: float) -> FloatArray:
    """Return the inverse standard deviations of a past, (m + n, m + n), as `OutputErrorProblem` takes them.

    Commands before an experiment are as large as those in it. A state deviates from the settled one `deviation` times
    as far as the states of the experiments, from rest, deviate from those that their commands settle in.
    """
    hold, total, count = -np.linalg.solve(system.A, system.B), np.zeros(system.A.shape), 0
    sampled = {dt: sample(system, dt) for dt in {experiment.dt for experiment in experiments}}
    respond = {dt: StateResponse(model.A) for dt, model in sampled.items()}
    for experiment in experiments:
        discrete = sampled[experiment.dt]
        inputs = taken(system, experiment)
        recent, older = delayed(inputs, discrete.delay, np.zeros(inputs.shape[1]))
        off = respond[experiment.dt]((discrete.B0 @ recent + discrete.B1 @ older)[:, None, :])[:, 0] - hold @ inputs.T
        total, count = total + off @ off.T, count + len(inputs)
    sizes, axes = np.linalg.eigh(total / count)
    sizes = deviation * np.sqrt(np.maximum(sizes, _MOVED**2 * max(sizes.max(), np.finfo(float).tiny)))
    usual = np.sqrt(np.mean(np.concatenate([e.inputs for e in experiments]) ** 2, axis=0))
    commands = np.diag(1.0 / np.maximum(usual, np.finfo(float).tiny ** 0.25))
    return np.asarray(linalg.block_diag(commands, axes.T / sizes[:, None]))


def _forced(model: _Model, inputs: FloatArray) -> FloatArray:
    """Simulate (n, K) states from rest under limited inputs (K, m)."""
    recent, older = delayed(inputs, model.sampled.delay, np.zeros(inputs.shape[1]))
    return model.respond((model.sampled.B0 @ recent + model.sampled.B1 @ older)[:, None, :])[:, 0]


def _project(rows: FloatArray, past: _Past) -> FloatArray:
    """Remove the effect of the past from `rows` (K p, ...) in place; return the rows of the prior (m + n, ...)."""
    early = rows[: len(past.outputs)]
    along = past.outputs.T @ early
    early -= past.outputs @ along
    return -past.prior @ along
