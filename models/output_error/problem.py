"""Output errors (measured outputs minus a simulation from the inputs) and their derivatives.

Each experiment has an unknown past: a previous command with its steady state, and a deviation from this state. A prior
keeps the deviation small; otherwise it would explain the transient, and dynamics and dead time would not be
identifiable from stretches that start with a step. Previous command and deviation enter linearly, so each evaluation
solves for them exactly and projects them out of the derivatives (variable projection, Golub and Pereyra 1973, with
Kaufman's simplification of 1975, whose gradient is exact). The number of parameters therefore does not depend on the
number of experiments.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import linalg

from diffdrive_mpc.models.interface import AnyArray, FloatArray
from diffdrive_mpc.models.output_error.experiment import SampledExperiment
from diffdrive_mpc.models.output_error.input_limits import limit_derivatives, limited_inputs
from diffdrive_mpc.models.output_error.parameters import Layout
from diffdrive_mpc.models.output_error.state_space import (
    LinearSystem,
    SampledSystem,
    StateResponse,
    delay_inputs,
    sample,
)

# Steps of this size cause no truncation error in complex-step differentiation.
_COMPLEX_STEP = 1e-30
# Relative singular value below which a direction of the past is unobservable and set to zero.
_MIN_SINGULAR_VALUE = 1e-9
# Minimum relative excitation of a direction of the state in the prior.
_MIN_EXCITATION = 1e-4
# Relative size at which the decaying effect of an initial state is neglected.
_DECAYED = 1e-12


_Drive = tuple[FloatArray, FloatArray]
"""Limited and delayed inputs of B0 and of B1, each (m, K)."""


class _Model(NamedTuple):
    """A sampled system, with the quantities shared by all experiments of one sample time."""

    system: LinearSystem
    sampled: SampledSystem
    respond: StateResponse
    steady_states: FloatArray
    """(n, m) steady states of unit inputs."""
    past: FloatArray
    """(n, m + n, E) states after unit previous commands and unit deviations, over the E samples until they decay."""


class _Past(NamedTuple):
    """Effect of the unknown past on the first E samples, in r directions."""

    outputs: FloatArray
    """(E p, r) output rows of an orthonormal basis of the effects of the past on outputs and prior."""
    prior: FloatArray
    """(m + n, r) prior rows of this basis."""
    recover: FloatArray
    """(m + n, r) map from components along the basis to previous command and deviation."""


class OutputErrorProblem:
    """Weighted residuals of several experiments as functions of the parameters of a layout.

    Parameters
    ----------
    layout
        Layout of the parameters.
    experiments
        The data.
    weights
        (K, p) non-negative factors of the residuals of each experiment; zero for samples that are not readings.
    prior
        (m + n, m + n) inverse standard deviations of the past of each experiment, previous command first; the product
        with the past is part of the residuals. See `past_prior`. None for no prior.
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
        self._max_samples = {experiment.dt: 0 for experiment in experiments}
        for experiment in experiments:
            self._max_samples[experiment.dt] = max(self._max_samples[experiment.dt], experiment.samples)

    def residuals(self, parameters: FloatArray) -> FloatArray:
        """Return the weighted residuals (rows,) of all experiments, then those of the pasts; inf if unstable."""
        system = self._layout.system(parameters)
        # The trust-region method rejects a step with infinite cost and reduces the region.
        if np.linalg.eigvals(system.A).real.max() >= 0:
            return np.full(self._rows + len(self._experiments) * (system.B.shape[1] + len(system.A)), np.inf)
        models = self._models(system)
        parts, pasts = [], []
        for experiment, weight, prior in zip(self._experiments, self._weights, self._prior, strict=True):
            model = models[experiment.dt]
            states = _simulate_from_rest(model, limited_inputs(system, experiment))
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
        """Simulate the outputs (K, p) of each experiment from the best past, including sensor offsets."""
        system = self._layout.system(parameters)
        models = self._models(system)
        return [
            _simulate(models[experiment.dt], experiment, weight, prior)[0].T @ system.C.T + system.offset
            for experiment, weight, prior in zip(self._experiments, self._weights, self._prior, strict=True)
        ]

    def _models(self, system: LinearSystem) -> dict[float, _Model]:
        """Discretise the system for each sample time of the data."""
        n, slowest = len(system.A), np.linalg.eigvals(system.A).real.max()
        steady_states = -np.linalg.solve(system.A, system.B)
        models = {}
        for dt, max_samples in self._max_samples.items():
            sampled = sample(system, dt)
            respond = StateResponse(sampled.A)
            # After the dead time the slowest pole decays to `_DECAYED`; later samples do not depend on the past.
            early = int(min(max_samples, n + 2 + sampled.delay.max() + np.log(_DECAYED) / (slowest * dt)))
            steps = np.arange(early)
            # A previous command still acts through B0 and B1 until the dead time has passed.
            before = [
                sampled.B0[:, [j]] * (steps < delay) + sampled.B1[:, [j]] * (steps < delay + 1)
                for j, delay in enumerate(sampled.delay)
            ]
            drive = np.stack([*before, *np.zeros((n, n, early))], axis=1)
            models[dt] = _Model(
                system, sampled, respond, steady_states, respond(drive, np.hstack([steady_states, np.eye(n)]))
            )
        return models

    def _derivatives(self, parameters: FloatArray, dt: float) -> tuple[LinearSystem, SampledSystem]:
        """Return the derivatives of the continuous and the sampled system with respect to each parameter, (q, ...)."""
        # B0 and B1 depend on the fractional part of a dead time, which is differentiable; its whole samples are fixed.
        stepped = parameters + 1j * _COMPLEX_STEP * np.eye(len(parameters))
        systems = LinearSystem(*map(np.array, zip(*map(self._layout.system, stepped), strict=True)))
        sampled = sample(systems, dt)

        def slope(value: AnyArray) -> FloatArray:
            return np.asarray(value.imag / _COMPLEX_STEP)

        return LinearSystem(*map(slope, systems)), SampledSystem(
            slope(sampled.A), slope(sampled.B0), slope(sampled.B1), sampled.delay
        )


def _past(model: _Model, weight: FloatArray, prior: FloatArray | None) -> _Past:
    states = model.past[..., : len(weight)]
    count = states.shape[1]
    rows = weight[: states.shape[-1], :, None] * np.moveaxis(np.tensordot(model.system.C, states, 1), 2, 0)
    prior_rows = np.zeros((count, count)) if prior is None else prior
    left, values, right = np.linalg.svd(np.vstack([rows.reshape(-1, count), prior_rows]), full_matrices=False)
    is_observable = values > _MIN_SINGULAR_VALUE * max(values[0], np.finfo(float).tiny)
    return _Past(
        left[:-count, is_observable], left[-count:, is_observable], right[is_observable].T / values[is_observable]
    )


def _simulate(
    model: _Model, experiment: SampledExperiment, weight: FloatArray, prior: FloatArray | None
) -> tuple[FloatArray, _Drive, FloatArray, _Past]:
    """Return the states (n, K) from the best past, the delayed inputs, the previous command, and the past's effect."""
    system, past = model.system, _past(model, weight, prior)
    inputs = limited_inputs(system, experiment)
    states = _simulate_from_rest(model, inputs)
    early = len(past.outputs) // experiment.outputs.shape[1]
    error = weight * (experiment.outputs - system.offset - states.T @ system.C.T)
    recovered = past.recover @ (past.outputs.T @ error[:early].ravel())
    states[:, :early] += np.tensordot(model.past[..., :early], recovered, (1, 0))
    before = recovered[: inputs.shape[1]]
    return states, delay_inputs(inputs, model.sampled.delay, before), before, past


def _experiment_jacobian(
    model: _Model,
    slope: LinearSystem,
    sampled_slope: SampledSystem,
    experiment: SampledExperiment,
    weight: FloatArray,
    prior: FloatArray | None,
) -> tuple[FloatArray, FloatArray]:
    """Return the derivatives of the weighted residuals of an experiment (K p, q) and of its past (m + n, q)."""
    states, (recent, older), before, past = _simulate(model, experiment, weight, prior)
    # The derivative of the states obeys the same recursion, driven by the derivatives of A, B0 and B1.
    forcing = sampled_slope.A @ states + sampled_slope.B0 @ recent + sampled_slope.B1 @ older
    # Estimated limits also change the inputs.
    if slope.limit.any():
        changes = limited_inputs(model.system, experiment, limit_derivatives)
        for rates, derivative in zip(np.moveaxis(slope.limit, -1, 0)[:, :, None, :], changes, strict=True):
            recent, older = delay_inputs(derivative, model.sampled.delay, np.zeros(derivative.shape[1]))
            forcing += (model.sampled.B0 * rates) @ recent + (model.sampled.B1 * rates) @ older
    steady_slope = np.asarray(-np.linalg.solve(model.system.A, ((slope.A @ model.steady_states + slope.B) @ before).T))
    sensitivity = model.respond(np.moveaxis(forcing, 0, 1), steady_slope)
    change = np.tensordot(model.system.C, sensitivity, 1) + np.moveaxis(slope.C @ states, 0, 1)
    change += slope.offset.T[:, :, None]
    rows = -(weight[:, :, None] * np.moveaxis(change, 2, 0)).reshape(weight.size, -1)
    return rows, _project(rows, past)


def past_prior(system: LinearSystem, experiments: Sequence[SampledExperiment], deviation: float) -> FloatArray:
    """Return the inverse standard deviations of a past, (m + n, m + n), for `OutputErrorProblem`.

    The standard deviation of the previous command is the rms value of the commands in the experiments. That of the
    deviation from its steady state is `deviation` times the rms difference between the states, simulated from rest, and
    the steady states of the current commands.
    """
    steady_states, total, count = -np.linalg.solve(system.A, system.B), np.zeros(system.A.shape), 0
    sampled = {dt: sample(system, dt) for dt in {experiment.dt for experiment in experiments}}
    respond = {dt: StateResponse(model.A) for dt, model in sampled.items()}
    for experiment in experiments:
        discrete = sampled[experiment.dt]
        inputs = limited_inputs(system, experiment)
        recent, older = delay_inputs(inputs, discrete.delay, np.zeros(inputs.shape[1]))
        difference = (
            respond[experiment.dt]((discrete.B0 @ recent + discrete.B1 @ older)[:, None, :])[:, 0]
            - steady_states @ inputs.T
        )
        total, count = total + difference @ difference.T, count + len(inputs)
    # Use principal axes of the deviations, so that the prior does not depend on the coordinates of the states.
    sizes, axes = np.linalg.eigh(total / count)
    sizes = deviation * np.sqrt(np.maximum(sizes, _MIN_EXCITATION**2 * max(sizes.max(), np.finfo(float).tiny)))
    rms = np.sqrt(np.mean(np.concatenate([e.inputs for e in experiments]) ** 2, axis=0))
    commands = np.diag(1.0 / np.maximum(rms, np.finfo(float).tiny ** 0.25))
    return np.asarray(linalg.block_diag(commands, axes.T / sizes[:, None]))


def _simulate_from_rest(model: _Model, inputs: FloatArray) -> FloatArray:
    """Simulate the states (n, K) from rest with limited inputs (K, m)."""
    recent, older = delay_inputs(inputs, model.sampled.delay, np.zeros(inputs.shape[1]))
    return model.respond((model.sampled.B0 @ recent + model.sampled.B1 @ older)[:, None, :])[:, 0]


def _project(rows: FloatArray, past: _Past) -> FloatArray:
    """Remove the effect of the past from `rows` (K p, ...) in place; return the prior rows (m + n, ...)."""
    early = rows[: len(past.outputs)]
    components = past.outputs.T @ early
    early -= past.outputs @ components
    return -past.prior @ components
