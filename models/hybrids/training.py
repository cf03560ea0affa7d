"""Training the network of a hybrid on free runs with JAX, which the extra `learn` installs; nothing else needs it.

The network stands inside the loop of the states, so what it says at a sample acts on all later ones: errors are those
of runs from the commands alone, cut into segments that are run side by side.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import minimize

from diffdrive_mpc.models.discrete_model import DiscreteModel
from diffdrive_mpc.models.errors import MissingPackageError
from diffdrive_mpc.models.hybrids.equations import gate, network
from diffdrive_mpc.models.hybrids.hybrid_model import Correction
from diffdrive_mpc.models.hybrids.settings import HybridSettings
from diffdrive_mpc.models.interface import FloatArray

_FORGOTTEN = 0.01
"""What is left of a start by the linear model when errors of a segment begin to count [-]."""
_SEGMENT = 4
"""Length of a segment over the time in which its start is forgotten."""
_NARROWEST = 1e-4
"""Least variance of the features in any direction [-]."""


class Run(NamedTuple):
    """K samples as the states see them."""

    states: FloatArray
    """(K, n) of the linear model, from the commands alone"""
    commands: FloatArray
    """(K, 2) newest that acts"""
    outputs: FloatArray
    """(K, 2) readings less the sensors' offsets"""
    counts: FloatArray
    """(K, 2) 1 where a reading counts, else 0"""


class Segments(NamedTuple):
    """S segments of L samples side by side."""

    starts: FloatArray
    """(S, n)"""
    commands: FloatArray
    """(S, L, 2)"""
    drives: FloatArray
    """(S, L, n) what commands add to the states of the linear model"""
    outputs: FloatArray
    """(S, L, 2)"""
    weights: FloatArray
    """(S, L, 2) of squared errors; 0 where none counts"""


def around(runs: Sequence[Run], settings: HybridSettings) -> Correction:
    """A correction that is silent yet, for the features of `runs`.

    Their covariance is about rest: as the network is odd, what was seen in one direction is known in the other.
    """
    rows = np.vstack([np.hstack([run.states, run.commands]) for run in runs])
    scale = np.maximum(np.sqrt(np.mean(rows**2, axis=0)), 1e-9)
    z = rows / scale
    shape = np.linalg.inv(z.T @ z / len(z) + _NARROWEST * np.eye(len(scale)))
    full = float(np.quantile(np.einsum("ki,ij,kj->k", z, shape, z), settings.full))
    n = runs[0].states.shape[1]
    inward = np.random.default_rng(settings.seed).normal(size=(n + 2, settings.units)) / np.sqrt(n + 2)
    return Correction(scale, inward, np.zeros((settings.units, n)), shape, full, settings.reach**2 * full)


def train(
    linear: DiscreteModel, runs: Sequence[Run], decays: Sequence[float], start: Correction, settings: HybridSettings
) -> list[Correction]:
    """The network with which the mean squared error is least, for each penalty of squared weights in turn.

    Errors count by what the linear model leaves of each output. Each search (L-BFGS, scipy) goes on from the last.

    Raises
    ------
    models.errors.MissingPackageError
        If JAX is not installed.
    """
    jax = libraries()
    found = []
    with jax.experimental.enable_x64():
        cost = _cost(linear, start, segments(linear, runs))
        p = np.concatenate([start.inward.ravel(), start.outward.ravel()])
        cut = start.inward.size
        for decay in decays:
            result = minimize(
                lambda p, decay=decay: cost(p, decay),
                p,
                jac=True,
                method="L-BFGS-B",
                options={"maxiter": settings.most_steps, "maxfun": 2 * settings.most_steps},
            )
            p = result.x
            inward, outward = p[:cut].reshape(start.inward.shape), p[cut:].reshape(start.outward.shape)
            found.append(Correction(start.scale, inward, outward, start.shape, start.full, start.least))
    return found


def segments(linear: DiscreteModel, runs: Sequence[Run]) -> Segments:
    """Runs cut into segments of equal length, each with a time before it in which its start is forgotten."""
    radius = float(np.abs(np.linalg.eigvals(linear.A)).max())
    before = max(1, int(np.ceil(np.log(_FORGOTTEN) / np.log(radius))))
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
            here = (rows >= first) & (rows < count)
            parts.append(
                (
                    run.states[inside[0]],
                    run.commands[inside],
                    np.where((rows >= 0)[:, None], drive[inside], settled),
                    run.outputs[inside],
                    run.counts[inside] * here[:, None] / power / 2.0,
                )
            )
    return Segments(*(np.array(column) for column in zip(*parts, strict=True)))


def libraries() -> Any:  # noqa: ANN401 - JAX is optional
    """JAX; raises MissingPackageError where it is not installed."""
    try:
        import jax  # noqa: PLC0415 - only training needs it
        import jax.experimental  # noqa: PLC0415
    except ImportError as error:
        raise MissingPackageError("training a hybrid needs JAX: pip install 'diffdrive-mpc[learn]'") from error
    return jax


def _cost(
    linear: DiscreteModel, start: Correction, given: Segments
) -> Callable[[FloatArray, float], tuple[float, FloatArray]]:
    """Cost and its gradient by the weights, for weights and penalty; the linear model alone costs 1."""
    jax = libraries()
    jnp, n, cut = jax.numpy, linear.order, start.inward.size
    A, C, scale, shape = (jnp.asarray(value) for value in (linear.A, linear.C, start.scale, start.shape))

    def error(inward: Any, outward: Any, one: Segments) -> Any:  # noqa: ANN401 - arrays of JAX
        def advance(x: Any, sample: Any) -> Any:  # noqa: ANN401
            command, drive, output, weight = sample
            z = jnp.concatenate([x, command]) / scale
            says = network(jnp, z, inward, outward) * gate(jnp, z, shape, start.full, start.least)
            return A @ x + drive + scale[:n] * says, weight @ (C @ x - output) ** 2

        return jnp.sum(jax.lax.scan(advance, one.starts, one[1:])[1])

    def cost(p: Any, decay: Any) -> Any:  # noqa: ANN401
        inward, outward = p[:cut].reshape(start.inward.shape), p[cut:].reshape(start.outward.shape)
        errors = jax.vmap(error, (None, None, 0))(inward, outward, Segments(*map(jnp.asarray, given)))
        return jnp.sum(errors) + decay * jnp.sum(p**2)

    both = jax.jit(jax.value_and_grad(cost))

    def evaluated(p: FloatArray, decay: float) -> tuple[float, FloatArray]:
        value, gradient = both(p, decay)
        return float(value), np.asarray(gradient, dtype=float)

    return evaluated
