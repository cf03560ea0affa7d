"""A continuous linear system with dead time, and how it is sampled, in arithmetic that takes complex numbers.

`models.discrete_model` samples a finished model through `control`. An estimator needs the derivatives too: a complex
step through the functions here gives them to machine precision.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from diffdrive_mpc.models.interface import FloatArray

AnyArray = NDArray[Any]
"""Real, or complex on the way to a derivative."""

_WHOLE = 1e-9


class LinearSystem(NamedTuple):
    """x' = A x + B clip(u(t - dead_time), -limit, limit), y = C x + offset; m inputs, p outputs.

    Leading axes stack systems.
    """

    A: AnyArray
    """(..., n, n)"""
    B: AnyArray
    """(..., n, m)"""
    C: AnyArray
    """(..., p, n)"""
    dead_time: AnyArray
    """(..., m) [s]"""
    offset: AnyArray
    """(..., p), units of the outputs"""
    limit: AnyArray
    """(..., m), units of the inputs; inf where the robot takes every command"""


class SampledSystem(NamedTuple):
    """x[k + 1] = A x[k] + B0 u[k - delay] + B1 u[k - delay - 1], as `models.discrete_model.DiscreteModel`."""

    A: AnyArray
    """(..., n, n)"""
    B0: AnyArray
    """(..., n, m)"""
    B1: AnyArray
    """(..., n, m)"""
    delay: NDArray[np.int64]
    """(..., m) whole samples"""


def sample(system: LinearSystem, dt: float) -> SampledSystem:
    """Exact zero-order hold with sample time `dt` [s]."""
    n, m = system.B.shape[-2:]
    delay = np.floor(system.dead_time.real / dt + _WHOLE).astype(np.int64)
    acting = dt - (system.dead_time - delay * dt)
    block = np.zeros((*system.A.shape[:-2], n + m, n + m), dtype=system.A.dtype)
    block[..., :n, :] = np.concatenate([system.A, system.B], axis=-1)
    whole = linalg.expm(block * dt)
    parts = linalg.expm(block[..., None, :, :] * acting[..., :, None, None])
    B0 = np.stack([parts[..., j, :n, n + j] for j in range(m)], axis=-1)
    return SampledSystem(whole[..., :n, :n], B0, whole[..., :n, n:] - B0, delay)


def delayed(
    inputs: FloatArray, delay: NDArray[np.int64], before: FloatArray | None = None
) -> tuple[FloatArray, FloatArray]:
    """Inputs (K, m) as B0 and B1 see them, each (m, K).

    Before sample 0 `before` (m,) was in force; by default the first row.
    """
    longest = int(delay.max()) + 1
    line = np.vstack([np.tile(inputs[0] if before is None else before, (longest, 1)), inputs])
    rows = np.arange(len(inputs)) + longest
    recent, older = ([line[rows - d - lag, j] for j, d in enumerate(delay)] for lag in (0, 1))
    return np.array(recent), np.array(older)


def settled_start(system: LinearSystem, outputs: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The settled state (n,) whose output is `outputs` (p,), and the input (m,) that holds it.

    For a single two-pole transfer function the output is as given and its derivative zero; where outputs determine the
    state, it is that state. With fewer inputs than outputs it is the nearest.
    """
    hold = -np.linalg.solve(system.A, system.B)
    inputs = np.linalg.lstsq(system.C @ hold, outputs - system.offset, rcond=None)[0]
    return np.asarray(hold @ inputs), np.asarray(inputs)
