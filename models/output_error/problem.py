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


_Drive = tuple[FloatArray, FloatArray]
"""Limited and delayed inputs of B0 and of B1, each (m, S, K)."""


class _Batch(NamedTuple):
    """S experiments of one sample time, extended by zeros to K samples, simulated together."""

    indices: list[int]
    experiments: list[SampledExperiment]
    dt: float
    inputs: FloatArray
    """(S, K, m)"""
    outputs: FloatArray
    """(S, K, p)"""

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
    for i, experiment in enumerate(experiments):
        length = -i if experiment.samples >= _LONG else experiment.samples.bit_length()
        groups.setdefault((experiment.dt, length), []).append(i)
    batches = []
    for (dt, _), indices in groups.items():
        parts = [experiments[i] for i in indices]
        inputs, outputs = _stacked([part.inputs for part in parts]), _stacked([part.outputs for part in parts])
        batches.append(_Batch(indices, parts, dt, inputs, outputs))
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


class _Past(NamedTuple):
    """Effect of the unknown pasts of S experiments on the first E samples, in m + n directions; zero if unobservable."""

    outputs: FloatArray
    """(S, E p, m + n) output rows of an orthonormal basis of the effects of the past on outputs and prior."""
    prior: FloatArray
    """(S, m + n, m + n) prior rows of this basis."""
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
        self._layout, self._samples = layout, [len(weight) for weight in weights]
        self._batches: list[tuple[_Batch, FloatArray, FloatArray | None]] = []
        self._max_samples: dict[float, int] = {}
        for batch in _batches(experiments):
            priors = None if prior is None else np.stack([prior[i] for i in batch.indices])
            self._batches.append((batch, _stacked([weights[i] for i in batch.indices]), priors))
            self._max_samples[batch.dt] = max(self._max_samples.get(batch.dt, 0), batch.inputs.shape[1])

    def residuals(self, parameters: FloatArray) -> FloatArray:
        """Return the weighted residuals (rows,) of all experiments, then those of the pasts; inf if unstable."""
        system = self._layout.system(parameters)
        # The trust-region method rejects a step with infinite cost and reduces the region.
        if np.linalg.eigvals(system.A).real.max() >= 0:
            rows = sum(self._samples) * len(system.C)
            return np.full(rows + len(self._samples) * (system.B.shape[1] + len(system.A)), np.inf)
        models = self._models(system)
        parts = []
        for batch, weight, prior in self._batches:
            model = models[batch.dt]
            error = _errors(model, batch, weight, _simulate_from_rest(model, batch.limited(system)))
            parts.append((error, _project(error, _past(model, weight, prior))))
        return self._ordered(parts)[:, 0]

    def jacobian(self, parameters: FloatArray) -> FloatArray:
        """Return the (rows, q) derivatives of `residuals`."""
        system = self._layout.system(parameters)
        models = self._models(system)
        slopes = {dt: self._derivatives(parameters, dt) for dt in models}
        return self._ordered([_jacobian(models[part[0].dt], *slopes[part[0].dt], *part) for part in self._batches])

    def simulations(self, parameters: FloatArray) -> list[FloatArray]:
        """Simulate the outputs (K, p) of each experiment from the best past, including sensor offsets."""
        system = self._layout.system(parameters)
        models, simulated = self._models(system), {}
        for batch, weight, prior in self._batches:
            states = _simulate(models[batch.dt], batch, weight, prior)[0]
            simulated |= zip(batch.indices, np.moveaxis(states, 0, -1) @ system.C.T + system.offset, strict=True)
        return [simulated[i][:samples] for i, samples in enumerate(self._samples)]

    def _ordered(self, parts: Sequence[tuple[FloatArray, FloatArray]]) -> FloatArray:
        """Concatenate rows (S, K p, q) of all experiments without their extension, then those (S, m + n, q) of pasts."""
        rows: dict[int, FloatArray] = {}
        pasts: dict[int, FloatArray] = {}
        for (batch, weight, _), (errors, past) in zip(self._batches, parts, strict=True):
            rows |= {i: part[: self._samples[i] * weight.shape[2]] for i, part in zip(batch.indices, errors, strict=True)}
            pasts |= zip(batch.indices, past, strict=True)
        return np.concatenate([part[i] for part in (rows, pasts) for i in range(len(self._samples))])

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
    states = model.past[..., : weight.shape[1]]
    count, early = states.shape[1:]
    rows = weight[:, :early, :, None] * np.moveaxis(np.tensordot(model.system.C, states, 1), 2, 0)
    prior_rows = np.zeros((len(weight), count, count)) if prior is None else prior
    left, values, right = np.linalg.svd(
        np.concatenate([rows.reshape(len(weight), -1, count), prior_rows], axis=1), full_matrices=False
    )
    is_observable = values > _MIN_SINGULAR_VALUE * np.maximum(values[:, :1], np.finfo(float).tiny)
    left *= is_observable[:, None]
    inverse = is_observable / np.where(is_observable, values, 1.0)
    return _Past(left[:, :-count], left[:, -count:], np.swapaxes(right, 1, 2) * inverse[:, None])


def _errors(model: _Model, batch: _Batch, weight: FloatArray, states: FloatArray) -> FloatArray:
    """Return weighted errors (S, K p, 1) of simulated states (n, S, K)."""
    outputs = np.moveaxis(states, 0, -1) @ model.system.C.T
    return np.asarray((weight * (batch.outputs - model.system.offset - outputs)).reshape(len(weight), -1, 1))


def _simulate(
    model: _Model, batch: _Batch, weight: FloatArray, prior: FloatArray | None
) -> tuple[FloatArray, _Drive, FloatArray, _Past]:
    """Return states (n, S, K) from the best past, delayed inputs, previous commands (m, S), and the past's effect."""
    past, inputs = _past(model, weight, prior), batch.limited(model.system)
    states = _simulate_from_rest(model, inputs)
    rows = past.outputs.shape[1]
    early = rows // weight.shape[2]
    error = _errors(model, batch, weight, states)[:, :rows]
    recovered = (past.recover @ (np.swapaxes(past.outputs, 1, 2) @ error))[..., 0].T
    states[..., :early] += np.moveaxis(np.tensordot(model.past[..., :early], recovered, (1, 0)), 1, 2)
    before = recovered[: inputs.shape[2]]
    return states, delay_inputs(inputs, model.sampled.delay, before.T), before, past


def _jacobian(
    model: _Model,
    slope: LinearSystem,
    sampled_slope: SampledSystem,
    batch: _Batch,
    weight: FloatArray,
    prior: FloatArray | None,
) -> tuple[FloatArray, FloatArray]:
    """Return the derivatives of the weighted residuals of S experiments (S, K p, q) and of pasts (S, m + n, q)."""
    states, (recent, older), before, past = _simulate(model, batch, weight, prior)
    count = len(slope.A)

    def flat(values: FloatArray) -> FloatArray:
        return values.reshape(len(values), -1)

    # The derivative of the states obeys the same recursion, driven by the derivatives of A, B0 and B1.
    forcing = sampled_slope.A @ flat(states) + sampled_slope.B0 @ flat(recent) + sampled_slope.B1 @ flat(older)
    # Estimated limits also change the inputs.
    if slope.limit.any():
        changes = batch.limited(model.system, limit_derivatives)
        for rates, derivative in zip(np.moveaxis(slope.limit, -1, 0)[:, :, None, :], changes, strict=True):
            recent, older = delay_inputs(derivative, model.sampled.delay, np.zeros(derivative.shape[::2]))
            forcing += (model.sampled.B0 * rates) @ flat(recent) + (model.sampled.B1 * rates) @ flat(older)
    change = np.moveaxis((slope.A @ model.steady_states + slope.B) @ before, 0, 1)
    steady_slope = np.asarray(-np.linalg.solve(model.system.A, flat(change)))
    drive = np.moveaxis(forcing, 0, 1).reshape(len(states), -1, states.shape[2])
    sensitivity = model.respond(drive, steady_slope)
    outputs = np.tensordot(model.system.C, sensitivity, 1).reshape(weight.shape[2], count, -1)
    outputs += np.moveaxis(slope.C @ flat(states), 0, 1) + slope.offset.T[:, :, None]
    rows = np.transpose(outputs.reshape(weight.shape[2], count, *weight.shape[:2]), (2, 3, 0, 1))
    rows = -(weight[..., None] * rows).reshape(len(weight), -1, count)
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
    for batch in _batches(experiments):
        discrete = sampled[batch.dt]
        inputs = batch.limited(system)
        recent, older = delay_inputs(inputs, discrete.delay, np.zeros(inputs.shape[::2]))
        states = respond[batch.dt](np.tensordot(discrete.B0, recent, 1) + np.tensordot(discrete.B1, older, 1))
        # The extensions of the experiments do not count.
        ends = np.array([[experiment.samples] for experiment in batch.experiments])
        counts = np.arange(inputs.shape[1]) < ends
        difference = (states - np.tensordot(steady_states, inputs, (1, 2)))[:, counts]
        total, count = total + difference @ difference.T, count + difference.shape[1]
    # Use principal axes of the deviations, so that the prior does not depend on the coordinates of the states.
    sizes, axes = np.linalg.eigh(total / count)
    sizes = deviation * np.sqrt(np.maximum(sizes, _MIN_EXCITATION**2 * max(sizes.max(), np.finfo(float).tiny)))
    rms = np.sqrt(np.mean(np.concatenate([e.inputs for e in experiments]) ** 2, axis=0))
    commands = np.diag(1.0 / np.maximum(rms, np.finfo(float).tiny ** 0.25))
    return np.asarray(linalg.block_diag(commands, axes.T / sizes[:, None]))


def _simulate_from_rest(model: _Model, inputs: FloatArray) -> FloatArray:
    """Simulate the states (n, S, K) from rest with limited inputs (S, K, m)."""
    recent, older = delay_inputs(inputs, model.sampled.delay, np.zeros(inputs.shape[::2]))
    return model.respond(np.tensordot(model.sampled.B0, recent, 1) + np.tensordot(model.sampled.B1, older, 1))


def _project(rows: FloatArray, past: _Past) -> FloatArray:
    """Remove the effect of the pasts from `rows` (S, K p, q) in place; return the prior rows (S, m + n, q)."""
    early = rows[:, : past.outputs.shape[1]]
    components = np.swapaxes(past.outputs, 1, 2) @ early
    early -= past.outputs @ components
    return np.asarray(-past.prior @ components)
