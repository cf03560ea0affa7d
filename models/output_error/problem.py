"""Output error: measured outputs minus a simulation from the inputs alone, and its derivatives.

Each experiment has an initial state of its own. It enters linearly, so it is solved for exactly inside every evaluation
and projected out of the derivatives (variable projection, Golub and Pereyra 1973, with Kaufman's 1975 simplification,
whose gradient is exact): any number of experiments costs no parameter.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.output_error.experiment import Experiment
from diffdrive_mpc.models.output_error.layout import Layout
from diffdrive_mpc.models.output_error.linear_system import (
    AnyArray,
    LinearSystem,
    SampledSystem,
    StateResponse,
    delayed,
    sample,
)

# Any step this small is exact in complex arithmetic.
_COMPLEX_STEP = 1e-30
# Directions of the initial state that the outputs show less than this, relative to the best seen, are left at zero.
_SEEN = 1e-9
# What is left of an initial state counts no more once its slowest part has decayed to this.
_DECAYED = 1e-12


class _Drive(NamedTuple):
    """Clipped inputs as B0 and B1 see them (m, K), and where they are clipped, with the command's sign (m, K)."""

    recent: FloatArray
    older: FloatArray
    recent_clipped: FloatArray
    older_clipped: FloatArray


class _Model(NamedTuple):
    """A system sampled at one rate, with what every experiment of that rate shares."""

    system: LinearSystem
    sampled: SampledSystem
    respond: StateResponse
    free: FloatArray
    """(n, n, E) states from each unit initial state, until they have decayed."""


class _InitialState(NamedTuple):
    """What an initial state can explain, E early samples long."""

    seen: FloatArray
    """(E p, r) orthonormal basis of the weighted outputs that initial states give."""
    recover: FloatArray
    """(n, r) from components along the basis to the initial state."""


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
    """

    def __init__(self, layout: Layout, experiments: Sequence[Experiment], weights: Sequence[FloatArray]) -> None:
        self._layout, self._experiments, self._weights = layout, list(experiments), list(weights)
        self._rows = sum(weight.size for weight in weights)
        self._longest = {experiment.dt: 0 for experiment in experiments}
        for experiment in experiments:
            self._longest[experiment.dt] = max(self._longest[experiment.dt], experiment.samples)

    def residuals(self, parameters: FloatArray) -> FloatArray:
        """(rows,) weighted residuals by experiment and sample; infinite where the model is unstable."""
        system = self._layout.system(parameters)
        if np.linalg.eigvals(system.A).real.max() >= 0:
            return np.full(self._rows, np.inf)
        models = self._models(system)
        parts = []
        for experiment, weight in zip(self._experiments, self._weights, strict=True):
            model = models[experiment.dt]
            states = _forced(model, _drive(model, experiment))
            error = (weight * (experiment.outputs - system.offset - states.T @ system.C.T)).ravel()
            _project(error, _initial_state(model, weight).seen)
            parts.append(error)
        return np.concatenate(parts)

    def jacobian(self, parameters: FloatArray) -> FloatArray:
        """(rows, q) derivatives of `residuals`."""
        system = self._layout.system(parameters)
        models = self._models(system)
        slopes = {dt: self._derivatives(parameters, dt) for dt in models}
        return np.concatenate(
            [
                _experiment_jacobian(models[experiment.dt], *slopes[experiment.dt], experiment, weight)
                for experiment, weight in zip(self._experiments, self._weights, strict=True)
            ]
        )

    def simulations(self, parameters: FloatArray) -> list[FloatArray]:
        """For each experiment the simulated outputs (K, p), sensor offset included, from the best initial state."""
        system = self._layout.system(parameters)
        models = self._models(system)
        return [
            _simulate(models[experiment.dt], experiment, weight)[0].T @ system.C.T + system.offset
            for experiment, weight in zip(self._experiments, self._weights, strict=True)
        ]

    def _models(self, system: LinearSystem) -> dict[float, _Model]:
        """The system at every sample time of the data."""
        n, slowest = len(system.A), np.linalg.eigvals(system.A).real.max()
        models = {}
        for dt, longest in self._longest.items():
            sampled = sample(system, dt)
            respond = StateResponse(sampled.A)
            early = int(min(longest, n + np.log(_DECAYED) / (slowest * dt)))
            models[dt] = _Model(system, sampled, respond, respond(np.zeros((n, n, early)), np.eye(n)))
        return models

    def _derivatives(self, parameters: FloatArray, dt: float) -> tuple[LinearSystem, SampledSystem]:
        """Derivatives by each parameter, (q, ...), of the continuous and of the sampled system."""
        stepped = parameters + 1j * _COMPLEX_STEP * np.eye(len(parameters))
        systems = LinearSystem(*map(np.array, zip(*map(self._layout.system, stepped), strict=True)))
        sampled = sample(systems, dt)

        def slope(value: AnyArray) -> FloatArray:
            return np.asarray(value.imag / _COMPLEX_STEP)

        return LinearSystem(*map(slope, systems)), SampledSystem(
            slope(sampled.A), slope(sampled.B0), slope(sampled.B1), sampled.delay
        )


def _simulate(model: _Model, experiment: Experiment, weight: FloatArray) -> tuple[FloatArray, _Drive, _InitialState]:
    """States (n, K) from the best initial state, what drives them, and what an initial state can explain."""
    system, drive, initial = model.system, _drive(model, experiment), _initial_state(model, weight)
    states = _forced(model, drive)
    early = len(initial.seen) // experiment.outputs.shape[1]
    error = weight * (experiment.outputs - system.offset - states.T @ system.C.T)
    start = initial.recover @ (initial.seen.T @ error[:early].ravel())
    states[:, :early] += np.tensordot(model.free[..., :early], start, (1, 0))
    return states, drive, initial


def _experiment_jacobian(
    model: _Model, slope: LinearSystem, sampled_slope: SampledSystem, experiment: Experiment, weight: FloatArray
) -> FloatArray:
    """(K p, q) derivatives of an experiment's weighted residuals."""
    states, drive, initial = _simulate(model, experiment, weight)
    forcing = sampled_slope.A @ states + sampled_slope.B0 @ drive.recent + sampled_slope.B1 @ drive.older
    if slope.limit.any():
        forcing += (model.sampled.B0 * slope.limit[:, None, :]) @ drive.recent_clipped
        forcing += (model.sampled.B1 * slope.limit[:, None, :]) @ drive.older_clipped
    sensitivity = model.respond(np.moveaxis(forcing, 0, 1))
    change = np.tensordot(model.system.C, sensitivity, 1) + np.moveaxis(slope.C @ states, 0, 1)
    change += slope.offset.T[:, :, None]
    rows = -(weight[:, :, None] * np.moveaxis(change, 2, 0)).reshape(weight.size, -1)
    _project(rows, initial.seen)
    return np.asarray(rows)


def _drive(model: _Model, experiment: Experiment) -> _Drive:
    limit, delay = model.system.limit, model.sampled.delay
    clipped = np.clip(experiment.inputs, -limit, limit)
    beyond = np.where(np.abs(experiment.inputs) > limit, np.sign(experiment.inputs), 0.0)
    return _Drive(*delayed(clipped, delay), *delayed(beyond, delay))


def _forced(model: _Model, drive: _Drive) -> FloatArray:
    """(n, K) states from rest."""
    return model.respond((model.sampled.B0 @ drive.recent + model.sampled.B1 @ drive.older)[:, None, :])[:, 0]


def _initial_state(model: _Model, weight: FloatArray) -> _InitialState:
    free = model.free[..., : len(weight)]
    rows = weight[: free.shape[-1], :, None] * np.moveaxis(np.tensordot(model.system.C, free, 1), 2, 0)
    left, values, right = np.linalg.svd(rows.reshape(-1, len(free)), full_matrices=False)
    keep = values > _SEEN * max(values[0], np.finfo(float).tiny)
    return _InitialState(left[:, keep], right[keep].T / values[keep])


def _project(rows: FloatArray, seen: FloatArray) -> None:
    """Take out of `rows` (K p, ...), in place, what an initial state can explain."""
    early = rows[: len(seen)]
    early -= seen @ (seen.T @ early)
