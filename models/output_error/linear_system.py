"""A continuous linear system with dead time: how it is sampled, and its states under any drive.

`models.discrete_model` samples a finished model. An estimator needs the derivatives too: the sampling
here takes complex numbers, and a complex step through it gives them to machine precision.
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


class StateResponse:
    """The states of x[k + 1] = A x[k] + drive[k], for any number of drives.

    In Schur coordinates A is triangular, so that each state is a first-order filter of the states after it; unlike a
    diagonal form this stays exact where poles meet.

    Parameters
    ----------
    A
        (n, n).
    """

    def __init__(self, A: FloatArray) -> None:
        triangle, basis = linalg.schur(A)
        if np.any(np.diag(triangle, -1)):  # complex poles
            triangle, basis = linalg.rsf2csf(triangle, basis)
        self._triangle, self._basis = triangle, basis

    def __call__(self, drive: FloatArray, start: FloatArray | None = None) -> FloatArray:
        """States (n, S, K) at samples 0 to K - 1.

        Parameters
        ----------
        drive
            (n, S, K): S drives of K samples.
        start
            (n, S) states at sample 0; zero by default.
        """
        from scipy import signal  # noqa: PLC0415 - loads slowly, and who only loads a model does without it

        adjoint, triangle = self._basis.conj().T, self._triangle
        states = np.tensordot(adjoint, drive, 1)
        first = np.tensordot(adjoint, np.zeros(drive.shape[:2]) if start is None else start, 1)
        for i in reversed(range(len(states))):
            for j in range(i + 1, len(states)):
                if triangle[i, j] != 0.0:
                    states[i] += triangle[i, j] * states[j]
            # lfilter's memory ahead of sample 0 is the state there.
            states[i] = signal.lfilter([0.0, 1.0], [1.0, -triangle[i, i]], states[i], zi=first[i][:, None])[0]
        return np.asarray(np.tensordot(self._basis, states, 1).real)
