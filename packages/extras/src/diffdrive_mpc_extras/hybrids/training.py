"""Training the network of a hybrid on free runs with JAX, which the extra `learn` installs; nothing else needs it.

The network is inside the loop of the states, so its output at a sample affects all later ones: errors are those of runs
from the commands alone, cut into segments that are run side by side.
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

from diffdrive_mpc.models.base_effects import limited
from diffdrive_mpc.models.checked_yaml import StrictModel, load_checked
from diffdrive_mpc.models.discrete_model import DiscreteModel
from diffdrive_mpc.models.errors import MissingPackageError
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.nonlinear_model import NonlinearModel
from diffdrive_mpc.models.output_error.experiment import SampledExperiment
from diffdrive_mpc.models.output_error.state_space import LinearSystem, StateResponse, steady_start
from diffdrive_mpc.models.robot import Positive
from diffdrive_mpc_extras.hybrids.hybrid_model import Correction, gate, network

# How the network of a hybrid is trained, read from `training.yaml`.


Count = Annotated[int, Field(ge=1)]
Share = Annotated[float, Field(gt=0, lt=1)]


class HybridSettings(StrictModel):
    """The numbers of a training."""

    units: Count = Field(description="of the one layer")
    full: Share = Field(description="share of the rows at which the network counts in full [-]")
    reach: float = Field(gt=1, description="distance at which it no longer counts, over that of full share [-]")
    decays: tuple[Positive, ...] = Field(min_length=1, description="penalties of squared weights, the strongest first")
    most_steps: Count = Field(description="of one search")
    min_gain: Share = Field(description="fall of the error power of held-out blocks that it has to bring [-]")
    seed: int = Field(ge=0)


@cache
def hybrid_settings() -> HybridSettings:
    """Read the file; raises ConfigError on a mistake in it."""
    return load_checked(HybridSettings, Path(__file__).with_name("training.yaml"))


_FORGOTTEN = 0.01
"""Rest of an initial error of the linear model when errors of a segment start to count [-]."""
_SEGMENT = 4
"""Length of a segment over the time in which the influence of its start decays."""
_MULTIPLE = 16
_NARROWEST = 1e-4
"""Least variance of the features in any direction [-]."""


class TrainingRun(NamedTuple):
    """K samples as the states see them."""

    states: FloatArray
    """(K, n) of the linear model, from the commands alone"""
    commands: FloatArray
    """(K, 2) newest that acts"""
    outputs: FloatArray
    """(K, 2) readings less the sensors' offsets"""
    counts: FloatArray
    """(K, 2) 1 where a reading counts, else 0"""
    sent: FloatArray
    """(K, 2) commands, within the levels at which the robot clips them"""
    before: FloatArray
    """(memory, 2) commands before them"""

    def simulate(self, model: NonlinearModel) -> FloatArray:
        """Simulate (K, 2) v and omega by a model with the same states, from the commands alone."""
        return model.simulate(self.sent, self.states[0], self.before)


class Segments(NamedTuple):
    """S segments of L samples side by side."""

    starts: FloatArray
    """(S, n)"""
    commands: FloatArray
    """(S, L, 2)"""
    drives: FloatArray
    """(S, L, n) contribution of the commands to the states of the linear model"""
    outputs: FloatArray
    """(S, L, 2)"""
    weights: FloatArray
    """(S, L, 2) of squared errors; 0 where none counts"""


def runs_of(linear: DiscreteModel, system: LinearSystem, experiments: Sequence[SampledExperiment]) -> list[TrainingRun]:
    """Convert experiments to runs that start in the steady state of their first readings; `linear` is of `system`."""
    runs = []
    for experiment in experiments:
        start, held = steady_start(system, experiment.first_readings)
        before = np.tile(held, (linear.memory, 1))
        sent = limited(experiment.inputs, system.limit, experiment.dt, held)
        recent, older = linear.effective_inputs(sent, before)
        drive = recent @ linear.B0.T + older @ linear.B1.T
        states = StateResponse(linear.A)(drive.T[:, None], start[:, None])[:, 0].T
        runs.append(
            TrainingRun(
                states, recent, experiment.outputs - system.offset, experiment.counts.astype(float), sent, before
            )
        )
    return runs


def silent(runs: Sequence[TrainingRun], settings: HybridSettings) -> Correction:
    """Build a correction of zero for the features of `runs`.

    Their covariance is about rest: as the network is odd, data of one direction hold for the other.
    """
    rows = np.vstack([np.hstack([run.states, run.commands]) for run in runs])
    scale = np.maximum(np.sqrt(np.mean(rows**2, axis=0)), 1e-9)
    z = rows / scale
    shape = np.linalg.inv(z.T @ z / len(z) + _NARROWEST * np.eye(len(scale)))
    full = float(np.quantile(np.einsum("ki,ij,kj->k", z, shape, z), settings.full))
    n = runs[0].states.shape[1]
    # The output weights are zero at first: the input weights must differ from unit to unit.
    inward = np.random.default_rng(settings.seed).normal(size=(n + 2, settings.units)) / np.sqrt(n + 2)
    return Correction(scale, inward, np.zeros((settings.units, n)), shape, full, settings.reach**2 * full)


def trained(
    linear: DiscreteModel, runs: Sequence[TrainingRun], decays: Sequence[float], settings: HybridSettings
) -> list[Correction]:
    """Train the network for the least mean squared error, for each penalty of squared weights in turn.

    Errors are weighted by the residual of the linear model in each output. Each search (L-BFGS, scipy) continues from
    the last.

    Raises
    ------
    models.errors.MissingPackageError
        If JAX is not installed.
    """
    jax, start, data = libraries(), silent(runs, settings), segments(linear, runs)
    fixed = (start.scale, start.shape, start.full, start.least)
    cut, networks = start.inward.size, []

    def apart(p: FloatArray) -> tuple[FloatArray, FloatArray]:
        return p[:cut].reshape(start.inward.shape), p[cut:].reshape(start.outward.shape)

    def cost(p: FloatArray, decay: float) -> tuple[float, FloatArray]:
        value, gradient = _compiled()(apart(p), decay, data, linear.A, linear.C, fixed)
        return float(value), np.concatenate([np.ravel(np.asarray(part)) for part in gradient])

    p = np.concatenate([start.inward.ravel(), start.outward.ravel()])
    with jax.experimental.enable_x64():
        for decay in decays:
            most = {"maxiter": settings.most_steps, "maxfun": 2 * settings.most_steps}
            p = minimize(cost, p, args=(decay,), jac=True, method="L-BFGS-B", options=most).x
            inward, outward = apart(p)
            networks.append(replace(start, inward=inward, outward=outward))
    return networks


def segments(linear: DiscreteModel, runs: Sequence[TrainingRun]) -> Segments:
    """Cut runs into segments of equal length, each preceded by a time in which its initial state decays.

    Length and number are whole multiples, the last segments weighing nothing: code that is compiled for one is used for
    others.
    """
    radius = float(np.abs(np.linalg.eigvals(linear.A)).max())
    before = _whole(np.log(_FORGOTTEN) / np.log(radius))
    parts: list[tuple[FloatArray, ...]] = []
    left = np.concatenate([(run.counts * (run.outputs - run.states @ linear.C.T)) for run in runs])
    power = np.maximum((left**2).sum(axis=0), 1e-12)
    for run in runs:
        count = len(run.states)
        drive = np.vstack([run.states[1:] - run.states[:-1] @ linear.A.T, np.zeros(linear.order)])
        settled = run.states[0] - linear.A @ run.states[0]
        for first in range(0, count, _SEGMENT * before):
            rows = np.arange(first - before, first + _SEGMENT * before)
            inside = np.clip(rows, 0, count - 1)
            inside_run = (rows >= first) & (rows < count)
            parts.append(
                (
                    run.states[inside[0]],
                    run.commands[inside],
                    np.where((rows >= 0)[:, None], drive[inside], settled),
                    run.outputs[inside],
                    run.counts[inside] * inside_run[:, None] / power / 2.0,
                )
            )
    parts += [(*parts[0][:-1], np.zeros_like(parts[0][-1]))] * (_whole(len(parts)) - len(parts))
    return Segments(*(np.array(column) for column in zip(*parts, strict=True)))


def _whole(count: float) -> int:
    """Round up to the next multiple."""
    return _MULTIPLE * max(1, int(np.ceil(count / _MULTIPLE)))


def libraries() -> Any:  # noqa: ANN401 - JAX is optional
    """Import JAX; raise MissingPackageError without it."""
    try:
        import jax  # noqa: PLC0415 - only training needs it
        import jax.experimental  # noqa: PLC0415
    except ImportError as error:
        raise MissingPackageError("training a hybrid needs JAX: pip install 'diffdrive-mpc[learn]'") from error
    return jax


@cache
def _compiled() -> Callable[..., Any]:
    """Compile cost and gradient by the weights in and out, for penalty, segments, linear model and gate."""
    jax = libraries()
    jnp = jax.numpy

    def cost(weights: Any, decay: Any, data: Segments, A: Any, C: Any, fixed: Any) -> Any:  # noqa: ANN401
        (inward, outward), (scale, shape, full, least) = weights, fixed

        def advance(x: Any, sample: Any) -> Any:  # noqa: ANN401 - arrays of JAX
            command, drive, output, weight = sample
            z = jnp.concatenate([x, command]) / scale
            says = network(jnp, z, inward, outward) * gate(jnp, z, shape, full, least)
            return A @ x + drive + scale[: len(x)] * says, weight @ (C @ x - output) ** 2

        def error(segments: Segments) -> Any:  # noqa: ANN401
            return jnp.sum(jax.lax.scan(advance, segments.starts, segments[1:])[1])

        return jnp.sum(jax.vmap(error)(data)) + decay * (jnp.sum(inward**2) + jnp.sum(outward**2))

    return jax.jit(jax.value_and_grad(cost))  # type: ignore[no-any-return]
