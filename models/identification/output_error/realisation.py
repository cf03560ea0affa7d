"""State-space models to start from, and a tidy form to hand over."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import linalg

from diffdrive_mpc.models.identification.output_error.linear_system import delayed
from diffdrive_mpc.models.identification.output_error.stretch import Stretch
from diffdrive_mpc.models.interface import FloatArray

Realisation = tuple[FloatArray, FloatArray, FloatArray]
"""A (n, n), B (n, m), C (p, n), continuous."""

# Ridge on the impulse response, part of the inputs' power: held set-points hardly tell neighbouring samples apart.
_RIDGE = 1e-4
_FAINT = 0.05


def impulse_response(stretches: Sequence[Stretch], dead_time: FloatArray, length: int) -> FloatArray:
    """(p, m, length) sampled impulse response behind dead times (m,) [s], by ridge regression on all stretches.

    Samples that do not count are interpolated: a start needs no more.
    """
    inputs, outputs = stretches[0].inputs.shape[1], stretches[0].outputs.shape[1]
    gram, moment = np.zeros((inputs * length,) * 2), np.zeros((inputs * length, outputs))
    for stretch in stretches:
        delay = np.floor(dead_time / stretch.dt).astype(np.int64)
        columns = [delayed(stretch.inputs, delay + lag)[1] for lag in range(length)]  # (m, K) each
        regressors = np.array(columns).reshape(length * inputs, -1)
        filled = np.column_stack([_filled(stretch, row) for row in range(outputs)])
        gram += regressors @ regressors.T
        moment += regressors @ filled
    gram += _RIDGE * np.trace(gram) / len(gram) * np.eye(len(gram))
    return np.asarray(np.linalg.solve(gram, moment).reshape(length, inputs, outputs).transpose(2, 1, 0))


def from_impulse_response(response: FloatArray, order: int, dt: float) -> Realisation | None:
    """A realisation of an impulse response (p, m, L), or None without a stable one.

    Eigensystem realization algorithm: Juang, Pappa, Journal of Guidance, Control, and Dynamics 1985, 8(5), 620-627.
    """
    import control  # noqa: PLC0415 - loads slowly, and only an SSM needs it

    padded = np.concatenate([np.zeros_like(response[..., :1]), response], axis=-1)
    # With a sample time the library takes the response for that to an impulse of unit area, 1 / dt high.
    system, _ = control.eigensys_realization(padded, order, dt=True)
    poles = np.linalg.eigvals(system.A)
    # A pole on the negative real axis has no continuous counterpart of the same order.
    if np.any(np.abs(poles) >= 1) or np.any((poles.real <= 0) & (np.abs(poles.imag) < 1e-9)):
        return None
    A = linalg.logm(system.A) / dt
    B = np.linalg.solve(system.A - np.eye(order), A @ system.B)
    return balanced(np.real(A), np.real(B), np.asarray(system.C))


def balanced(A: FloatArray, B: FloatArray, C: FloatArray) -> Realisation:
    """The same model in balanced coordinates, each state with its largest output entry positive.

    Source: Moore, IEEE Transactions on Automatic Control 1981, 26(1), 17-32. A state that is neither seen nor driven
    keeps its coordinates.
    """
    reach = linalg.solve_continuous_lyapunov(A, -B @ B.T)
    observe = linalg.solve_continuous_lyapunov(A.T, -C.T @ C)
    try:
        factor, weight = np.linalg.cholesky(reach), np.linalg.cholesky(observe)
    except np.linalg.LinAlgError:
        return A, B, C
    left, values, right = np.linalg.svd(weight.T @ factor)
    into = (left / np.sqrt(values)).T @ weight.T
    back = factor @ (right.T / np.sqrt(values))
    A, B, C = into @ A @ back, into @ B, C @ back
    sign = np.sign(C[np.argmax(np.abs(C), axis=0), np.arange(len(A))])
    return A * np.outer(sign, sign), B * sign[:, None], C * sign


def beside(first: Realisation, second: Realisation) -> Realisation:
    """The sum of two models' outputs."""
    return (
        linalg.block_diag(first[0], second[0]),
        np.vstack([first[1], second[1]]),
        np.hstack([first[2], second[2]]),
    )


def spare_state(A: FloatArray, B: FloatArray, C: FloatArray) -> Realisation:
    """One state, twice as fast as the fastest of a model and hardly seen: a place to start where data suggest none."""
    pole = 2.0 * np.abs(np.linalg.eigvals(A)).max()
    return (
        np.array([[-pole]]),
        _FAINT * np.abs(B).max(axis=0, keepdims=True),
        _FAINT * np.abs(C).max(axis=1, keepdims=True),
    )


def _filled(stretch: Stretch, row: int) -> FloatArray:
    known = np.flatnonzero(stretch.counts[:, row])
    return np.asarray(np.interp(np.arange(stretch.samples), known, stretch.outputs[known, row]))
