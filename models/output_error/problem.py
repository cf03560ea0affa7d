"""Output errors (measured outputs minus a simulation from the inputs) and their derivatives.

Each experiment has an unknown past: a previous command with its steady state, and a deviation from this state. A prior
keeps the deviation small; otherwise it would explain the transient, and dynamics and dead time would not be
identifiable from stretches that start with a step. Previous command and deviation enter linearly, so each evaluation
solves for them exactly and projects them out of the derivatives (variable projection, Golub and Pereyra 1973, with
Kaufman's simplification of 1975, whose gradient is exact). The number of parameters therefore does not depend on the
number of experiments.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy import linalg

from diffdrive_mpc.models.base_effects import apply_limits
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
# Number of samples from which an experiment is simulated separately.
_LONG = 1024


class _Batch(NamedTuple):
    """S experiments of one sample time, extended by zeros to K samples, simulated together."""

    dt: float
    indices: list[int]
    experiments: list[SampledExperiment]
    inputs: FloatArray
    """(S, K, m)"""
    outputs: FloatArray
    """(S, K, p)"""
    weight: FloatArray
    """(S, K, p) factors of the residuals; by default 1 for readings, 0 for other samples."""
    prior: FloatArray | float = 0.0
    """(S, m + n, m + n) inverse standard deviations of the pasts; 0 for no prior."""

    def limited(self, system: LinearSystem, function: Callable[..., FloatArray] = apply_limits) -> FloatArray:
        """Return `limited_inputs` of the experiments (..., S, K, m)."""
        if np.isinf(system.limit).all():
            return self.inputs
        return _stacked([limited_inputs(system, experiment, function) for experiment in self.experiments])


def _stacked(parts: Sequence[FloatArray]) -> FloatArray:
    """Stack arrays (..., K, r) of different K as (..., S, max K, r), extended by zeros."""
    *leading, _, columns = parts[0].shape
    stack = np.zeros((*leading, len(parts), max(part.shape[-2] for part in parts), columns))
    for i, part in enumerate(parts):
        stack[..., i, : part.shape[-2], :] = part
    return stack


def _batches(experiments: Sequence[SampledExperiment]) -> list[_Batch]:
    """Group experiments by sample time and length; lengths in a group differ by less than a factor of two."""
    groups: dict[tuple[float, int], list[int]] = {}
    for i, part in enumerate(experiments):
        length = -i if part.samples >= _LONG else part.samples.bit_length()
        groups.setdefault((part.dt, length), []).append(i)
    batches = []
    for (dt, _), indices in groups.items():
        parts = [experiments[i] for i in indices]
        arrays = (_stacked([getattr(part, name) for part in parts]) for name in ("inputs", "outputs", "counts"))
        batches.append(_Batch(dt, indices, parts, *arrays))
    return batches


class _Model(NamedTuple):
    """A sampled system, with the quantities shared by all experiments of one sample time."""

    system: LinearSystem
    sampled: SampledSystem
    respond: StateResponse
    steady_states: FloatArray
    """(n, m) steady states of unit inputs."""
    past: FloatArray
    """(n, m + n, E) states after unit previous commands and unit deviations, over the E samples until they decay."""


class _Response(NamedTuple):
    """Response of a batch from rest."""

    inputs: FloatArray
    """(S, K, m) limited inputs."""
    states: FloatArray
    """(n, S, K)"""


class _Past(NamedTuple):
    """Effect of the unknown pasts of S experiments on the first E samples; unobservable directions are zero."""

    outputs: FloatArray
    """(S, m + n, E p) orthonormal basis of the effects of the past on outputs and prior: its part for outputs."""
    prior: FloatArray
    """(S, m + n, m + n) rows of this basis for the prior."""
    recover: FloatArray
    """(S, m + n, m + n) map from components along the basis to previous command and deviation."""


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
    """

    def __init__(self, layout: Layout, experiments: Sequence[SampledExperiment], weights: Sequence[FloatArray]) -> None:
        self._layout, self._experiments, self._samples = layout, experiments, [len(weight) for weight in weights]
        self._batches, self._max_samples = [], dict.fromkeys((part.dt for part in experiments), 0)
        self._last: tuple[FloatArray, dict[float, _Model], list[_Response]] | None = None
        for batch in _batches(experiments):
            self._batches.append(batch._replace(weight=_stacked([weights[i] for i in batch.indices])))
            self._max_samples[batch.dt] = max(self._max_samples[batch.dt], batch.inputs.shape[1])

    def set_prior(self, near: FloatArray, deviation: float, factors: FloatArray) -> None:
        """Set the prior of the pasts for the system at the parameters `near` (q,).

        The standard deviation of the previous command is the rms value of the commands in the experiments. That of the
        deviation from its steady state is `deviation` times the rms difference between the states, simulated from rest,
        and the steady states of the current commands. The inverse standard deviations are multiplied by `factors`
        (experiments,); their product with the past is part of the residuals.
        """
        models, responses = self._simulate_from_rest(near)
        total, count = np.zeros(()), 0
        for batch, response in zip(self._batches, responses, strict=True):
            inputs, steady_states = response.inputs, models[batch.dt].steady_states
            is_sample = np.arange(inputs.shape[1]) < np.array([[part.samples] for part in batch.experiments])
            difference = (response.states - np.tensordot(steady_states, inputs, (1, 2)))[:, is_sample]
            total, count = total + difference @ difference.T, count + difference.shape[1]
        # Use principal axes of the deviations, so that the prior does not depend on the coordinates of the states.
        sizes, axes = np.linalg.eigh(total / count)
        sizes = deviation * np.sqrt(np.maximum(sizes, _MIN_EXCITATION**2 * max(sizes.max(), np.finfo(float).tiny)))
        rms = np.sqrt(np.mean(np.concatenate([e.inputs for e in self._experiments]) ** 2, axis=0))
        commands = np.diag(1.0 / np.maximum(rms, np.finfo(float).tiny ** 0.25))
        prior = linalg.block_diag(commands, axes.T / sizes[:, None])
        self._batches = [batch._replace(prior=factors[batch.indices, None, None] * prior) for batch in self._batches]

    def residuals(self, parameters: FloatArray) -> FloatArray:
        """Return the weighted residuals (rows,) of all experiments, then those of the pasts; inf if unstable."""
        system = self._layout.system(parameters)
        # The trust-region method rejects a step with infinite cost and reduces the region.
        if np.linalg.eigvals(system.A).real.max() >= 0:
            rows = sum(self._samples) * len(system.C)
            return np.full(rows + len(self._samples) * (system.B.shape[1] + len(system.A)), np.inf)
        (models, responses), parts = self._simulate_from_rest(parameters), []
        for batch, response in zip(self._batches, responses, strict=True):
            error = _errors(models[batch.dt], batch, response.states)
            parts.append((error, _project(error, _past(models[batch.dt], batch))))
        return self._ordered(parts)[:, 0]

    def jacobian(self, parameters: FloatArray) -> FloatArray:
        """Return the (rows, q) derivatives of `residuals`."""
        models, responses = self._simulate_from_rest(parameters)
        slopes = {dt: self._derivatives(parameters, dt) for dt in models}
        pairs = zip(self._batches, responses, strict=True)
        return self._ordered([_jacobian(models[batch.dt], *slopes[batch.dt], batch, part) for batch, part in pairs])

    def simulations(self, parameters: FloatArray) -> list[FloatArray]:
        """Simulate the outputs (K, p) of each experiment from the best past, including sensor offsets."""
        models, responses = self._simulate_from_rest(parameters)
        simulated: dict[int, FloatArray] = {}
        for batch, response in zip(self._batches, responses, strict=True):
            states, system = _simulate(models[batch.dt], batch, response)[0], models[batch.dt].system
            simulated |= zip(batch.indices, np.moveaxis(states, 0, -1) @ system.C.T + system.offset, strict=True)
        return [simulated[i][:samples] for i, samples in enumerate(self._samples)]

    def _simulate_from_rest(self, parameters: FloatArray) -> tuple[dict[float, _Model], list[_Response]]:
        """Return the model of each sample time, and the response of each batch from rest.

        The last result is stored, because the trust-region method evaluates residuals and derivatives at one point.
        """
        if self._last is None or not np.array_equal(self._last[0], parameters):
            models = self._models(self._layout.system(parameters))
            self._last = parameters.copy(), models, [_respond(models[batch.dt], batch) for batch in self._batches]
        return self._last[1:]

    def _ordered(self, parts: Sequence[tuple[FloatArray, FloatArray]]) -> FloatArray:
        """Concatenate rows (S, K p, q) of experiments without their extension, then those (S, m + n, q) of pasts."""
        rows, pasts = ([row for part in group for row in part] for group in zip(*parts, strict=True))
        order = np.argsort([i for batch in self._batches for i in batch.indices])
        ends = [samples * self._layout.outputs for samples in self._samples]
        return np.concatenate([rows[k][:end] for k, end in zip(order, ends, strict=True)] + [pasts[k] for k in order])

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


def _past(model: _Model, batch: _Batch) -> _Past:
    states = model.past[..., : batch.weight.shape[1]]
    size, (count, early) = len(batch.weight), states.shape[1:]
    effects = batch.weight[:, :early, :, None] * np.moveaxis(np.tensordot(model.system.C, states, 1), 2, 0)
    rows = [effects.reshape(size, -1, count), np.broadcast_to(batch.prior, (size, count, count))]
    left, values, right = np.linalg.svd(np.concatenate(rows, axis=1), full_matrices=False)
    is_observable = values > _MIN_SINGULAR_VALUE * np.maximum(values[:, :1], np.finfo(float).tiny)
    # This order in memory is fast in products.
    basis = np.ascontiguousarray(np.swapaxes(left * is_observable[:, None], 1, 2))
    outputs, prior = np.ascontiguousarray(basis[..., :-count]), np.swapaxes(basis[..., -count:], 1, 2)
    return _Past(outputs, prior, np.swapaxes(right, 1, 2) / np.where(is_observable, values, np.inf)[:, None])


def _errors(model: _Model, batch: _Batch, states: FloatArray) -> FloatArray:
    """Return weighted errors (S, K p, 1) of simulated states (n, S, K)."""
    error = batch.outputs - model.system.offset - np.moveaxis(states, 0, -1) @ model.system.C.T
    return np.asarray((batch.weight * error).reshape(len(error), -1, 1))


def _respond(model: _Model, batch: _Batch) -> _Response:
    inputs, sampled = batch.limited(model.system), model.sampled
    recent, older = delay_inputs(inputs, sampled.delay, np.zeros(inputs.shape[::2]))
    drive = np.tensordot(sampled.B0, recent, 1) + np.tensordot(sampled.B1, older, 1)
    return _Response(inputs, model.respond(drive))


def _simulate(
    model: _Model, batch: _Batch, response: _Response
) -> tuple[FloatArray, tuple[FloatArray, FloatArray], FloatArray, _Past]:
    """Return states (n, S, K) from the best past, delayed inputs, previous commands (m, S), and the past's effect."""
    past, inputs, states = _past(model, batch), response.inputs, response.states.copy()
    error = _errors(model, batch, states)[:, : past.outputs.shape[2]]
    recovered = (past.recover @ (past.outputs @ error))[..., 0].T
    effect = np.moveaxis(np.tensordot(model.past[..., : states.shape[2]], recovered, (1, 0)), 1, 2)
    states[..., : effect.shape[2]] += effect
    before = recovered[: inputs.shape[2]]
    return states, delay_inputs(inputs, model.sampled.delay, before.T), before, past


def _jacobian(
    model: _Model, slope: LinearSystem, sampled_slope: SampledSystem, batch: _Batch, response: _Response
) -> tuple[FloatArray, FloatArray]:
    """Return the derivatives of the weighted residuals of S experiments (S, K p, q) and of pasts (S, m + n, q)."""
    states, (recent, older), before, past = _simulate(model, batch, response)
    n, size, samples = states.shape
    states, recent, older = (values.reshape(len(values), -1) for values in (states, recent, older))
    # The derivative of the states obeys the same recursion, driven by the derivatives of A, B0 and B1.
    forcing = sampled_slope.A @ states + sampled_slope.B0 @ recent + sampled_slope.B1 @ older
    # Estimated limits also change the inputs.
    if slope.limit.any():
        changes = batch.limited(model.system, limit_derivatives)
        for rates, derivative in zip(np.moveaxis(slope.limit, -1, 0)[:, :, None, :], changes, strict=True):
            recent, older = delay_inputs(derivative, model.sampled.delay, np.zeros(derivative.shape[::2]))
            drive = (model.sampled.B0 * rates) @ recent.reshape(len(recent), -1)
            forcing += drive + (model.sampled.B1 * rates) @ older.reshape(len(older), -1)
    steady_slope = np.moveaxis((slope.A @ model.steady_states + slope.B) @ before, 0, 1).reshape(n, -1)
    start = np.asarray(-np.linalg.solve(model.system.A, steady_slope))
    sensitivity = model.respond(np.moveaxis(forcing, 0, 1).reshape(n, -1, samples), start)
    change = np.tensordot(model.system.C, sensitivity, 1).reshape(len(model.system.C), -1, size * samples)
    change += np.moveaxis(slope.C @ states, 0, 1) + slope.offset.T[:, :, None]
    rows = np.moveaxis(change, 2, 0).reshape(size, samples, *change.shape[:2])
    rows = -(batch.weight[..., None] * rows).reshape(size, -1, change.shape[1])
    return rows, _project(rows, past)


def _project(rows: FloatArray, past: _Past) -> FloatArray:
    """Remove the effect of the pasts from `rows` (S, K p, q) in place; return the prior rows (S, m + n, q)."""
    early = rows[:, : past.outputs.shape[2]]
    components = past.outputs @ early
    early -= np.swapaxes(past.outputs, 1, 2) @ components
    return np.asarray(-past.prior @ components)
