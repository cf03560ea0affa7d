"""Training of the network of a hybrid on free runs, with JAX from the extra `learn`.

The output of the network at a sample affects all later states. The training therefore minimises the errors of free
runs, which are simulated from the commands only. The runs are cut into segments, which are simulated in parallel.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
from pydantic import Field
from scipy.optimize import minimize

from diffdrive_mpc.models.base_effects import apply_limits
from diffdrive_mpc.models.checked_yaml import StrictModel, load_checked
from diffdrive_mpc.models.discrete_model import DiscreteModel
from diffdrive_mpc.models.errors import MissingPackageError
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.nonlinear_model import NonlinearModel
from diffdrive_mpc.models.output_error.experiment import SampledExperiment
from diffdrive_mpc.models.output_error.state_space import LinearSystem, StateResponse, steady_start
from diffdrive_mpc.models.robot import Positive
from diffdrive_mpc_extras.hybrids.hybrid_model import Correction, gate, network

Count = Annotated[int, Field(ge=1)]
Share = Annotated[float, Field(gt=0, lt=1)]


class HybridSettings(StrictModel):
    """Settings of the training, read from `training.yaml`."""

    units: Count = Field(description="number of units of the hidden layer")
    full: Share = Field(description="fraction of the training rows at which the gate is 1 [-]")
    reach: float = Field(gt=1, description="distance at which the gate becomes 0, over the maximum distance of 1 [-]")
    decays: tuple[Positive, ...] = Field(min_length=1, description="penalties of squared weights, in descending order")
    max_steps: Count = Field(description="maximum number of steps of one search")
    min_gain: Share = Field(description="minimum relative reduction of the squared error on held-out blocks [-]")
    seed: int = Field(ge=0, description="seed of the initial weights")


@cache
def hybrid_settings() -> HybridSettings:
    """Load the settings; raise ConfigError if the file is invalid."""
    return load_checked(HybridSettings, Path(__file__).with_name("training.yaml"))


_INITIAL_ERROR_DECAY = 0.01
"""Remaining fraction of an initial error of the linear model at the first counted sample of a segment [-]."""
_SEGMENT = 4
"""Length of a segment over the decay time of its initial error [-]."""
_MULTIPLE = 16
_MIN_VARIANCE = 1e-4
"""Regularisation of the covariance of the features: minimum variance in any direction [-]."""


class TrainingRun(NamedTuple):
    """Training data of K consecutive samples."""

    states: FloatArray
    """(K, n) states of the linear model, simulated from the commands."""
    commands: FloatArray
    """(K, 2) delayed commands, as they act on the model."""
    outputs: FloatArray
    """(K, 2) readings minus the offsets of the sensors."""
    counts: FloatArray
    """(K, 2) 1 if a reading counts, else 0."""
    sent: FloatArray
    """(K, 2) commands without delay, clipped at the limits of the robot."""
    before: FloatArray
    """(memory, 2) commands before the first sample."""

    def simulate(self, model: NonlinearModel) -> FloatArray:
        """Simulate (K, 2) v and omega by a model with the same states, from the commands alone."""
        return model.simulate(self.sent, self.states[0], self.before)


class Segments(NamedTuple):
    """S segments of L samples, simulated in parallel."""

    starts: FloatArray
    """(S, n) initial states."""
    commands: FloatArray
    """(S, L, 2) delayed commands."""
    drives: FloatArray
    """(S, L, n) contribution of the commands to the states of the linear model."""
    outputs: FloatArray
    """(S, L, 2) readings."""
    weights: FloatArray
    """(S, L, 2) weights of the squared errors; 0 if a reading does not count."""


def training_runs(
    linear: DiscreteModel, system: LinearSystem, experiments: Sequence[SampledExperiment]
) -> list[TrainingRun]:
    """Convert experiments to runs from the steady state of their first readings; `linear` is `system`, discretised."""
    runs = []
    for experiment in experiments:
        start, command = steady_start(system, experiment.first_readings)
        before = np.tile(command, (linear.memory, 1))
        sent = apply_limits(experiment.inputs, system.limit, experiment.dt, command)
        recent, older = linear.effective_inputs(sent, before)
        drive = recent @ linear.B0.T + older @ linear.B1.T
        states = StateResponse(linear.A)(drive.T[:, None], start[:, None])[:, 0].T
        runs.append(
            TrainingRun(
                states, recent, experiment.outputs - system.offset, experiment.counts.astype(float), sent, before
            )
        )
    return runs


def zero_correction(runs: Sequence[TrainingRun], settings: HybridSettings) -> Correction:
    """Build a correction with zero output, scaled to the features of `runs`.

    The covariance is computed about rest because the network is odd: data of one direction determine both directions.
    """
    rows = np.vstack([np.hstack([run.states, run.commands]) for run in runs])
    scale = np.maximum(np.sqrt(np.mean(rows**2, axis=0)), 1e-9)
    z = rows / scale
    shape = np.linalg.inv(z.T @ z / len(z) + _MIN_VARIANCE * np.eye(len(scale)))
    full = float(np.quantile(np.einsum("ki,ij,kj->k", z, shape, z), settings.full))
    n = runs[0].states.shape[1]
    # The output weights start at zero, so random input weights must break the symmetry of the units.
    inward = np.random.default_rng(settings.seed).normal(size=(n + 2, settings.units)) / np.sqrt(n + 2)
    return Correction(scale, inward, np.zeros((settings.units, n)), shape, full, settings.reach**2 * full)


def train_corrections(
    linear: DiscreteModel, runs: Sequence[TrainingRun], decays: Sequence[float], settings: HybridSettings
) -> list[Correction]:
    """Train the network to minimise the mean squared error, for each penalty in `decays`; return one per penalty.

    The squared error of each output is divided by that of the linear model. Each search (L-BFGS, SciPy) starts from the
    result of the previous search.

    Raises
    ------
    models.errors.MissingPackageError
        If JAX is not installed.
    """
    jax, start, data = import_jax(), zero_correction(runs, settings), make_segments(linear, runs)
    constants = (start.scale, start.shape, start.full, start.least)
    size, networks = start.inward.size, []

    def split(p: FloatArray) -> tuple[FloatArray, FloatArray]:
        return p[:size].reshape(start.inward.shape), p[size:].reshape(start.outward.shape)

    def cost(p: FloatArray, decay: float) -> tuple[float, FloatArray]:
        value, gradient = _compile_cost()(split(p), decay, data, linear.A, linear.C, constants)
        return float(value), np.concatenate([np.ravel(np.asarray(part)) for part in gradient])

    p = np.concatenate([start.inward.ravel(), start.outward.ravel()])
    with jax.experimental.enable_x64():
        for decay in decays:
            limits = {"maxiter": settings.max_steps, "maxfun": 2 * settings.max_steps}
            p = minimize(cost, p, args=(decay,), jac=True, method="L-BFGS-B", options=limits).x
            inward, outward = split(p)
            networks.append(replace(start, inward=inward, outward=outward))
    return networks


def make_segments(linear: DiscreteModel, runs: Sequence[TrainingRun]) -> Segments:
    """Cut runs into segments of equal length, each with initial samples that do not count until its start has decayed.

    Length and number of the segments are rounded up, with additional segments of zero weight, so that compiled code
    can be reused.
    """
    radius = float(np.abs(np.linalg.eigvals(linear.A)).max())
    decay_samples = _round_up(np.log(_INITIAL_ERROR_DECAY) / np.log(radius))
    parts: list[tuple[FloatArray, ...]] = []
    residuals = np.concatenate([(run.counts * (run.outputs - run.states @ linear.C.T)) for run in runs])
    power = np.maximum((residuals**2).sum(axis=0), 1e-12)
    for run in runs:
        count = len(run.states)
        drive = np.vstack([run.states[1:] - run.states[:-1] @ linear.A.T, np.zeros(linear.order)])
        steady_drive = run.states[0] - linear.A @ run.states[0]
        for first in range(0, count, _SEGMENT * decay_samples):
            rows = np.arange(first - decay_samples, first + _SEGMENT * decay_samples)
            clipped = np.clip(rows, 0, count - 1)
            is_counted = (rows >= first) & (rows < count)
            parts.append(
                (
                    run.states[clipped[0]],
                    run.commands[clipped],
                    np.where((rows >= 0)[:, None], drive[clipped], steady_drive),
                    run.outputs[clipped],
                    run.counts[clipped] * is_counted[:, None] / power / 2.0,
                )
            )
    parts += [(*parts[0][:-1], np.zeros_like(parts[0][-1]))] * (_round_up(len(parts)) - len(parts))
    return Segments(*(np.array(column) for column in zip(*parts, strict=True)))


def _round_up(count: float) -> int:
    """Round up to a multiple of `_MULTIPLE`."""
    return _MULTIPLE * max(1, int(np.ceil(count / _MULTIPLE)))


def import_jax() -> Any:  # noqa: ANN401 - JAX is optional
    """Import JAX; raise MissingPackageError if it is not installed."""
    try:
        import jax  # noqa: PLC0415 - only training needs it
        import jax.experimental  # noqa: PLC0415
    except ImportError as error:
        raise MissingPackageError("training a hybrid needs JAX: pip install 'diffdrive-mpc[learn]'") from error
    return jax


@cache
def _compile_cost() -> Callable[..., Any]:
    """Compile the cost and its gradient with respect to the weights."""
    jax = import_jax()
    jnp = jax.numpy

    def cost(weights: Any, decay: Any, data: Segments, A: Any, C: Any, constants: Any) -> Any:  # noqa: ANN401
        (inward, outward), (scale, shape, full, least) = weights, constants

        def advance(x: Any, sample: Any) -> Any:  # noqa: ANN401 - arrays of JAX
            command, drive, output, weight = sample
            z = jnp.concatenate([x, command]) / scale
            change = network(jnp, z, inward, outward) * gate(jnp, z, shape, full, least)
            return A @ x + drive + scale[: len(x)] * change, weight @ (C @ x - output) ** 2

        def error(segments: Segments) -> Any:  # noqa: ANN401
            return jnp.sum(jax.lax.scan(advance, segments.starts, segments[1:])[1])

        return jnp.sum(jax.vmap(error)(data)) + decay * (jnp.sum(inward**2) + jnp.sum(outward**2))

    return jax.jit(jax.value_and_grad(cost))  # type: ignore[no-any-return]
