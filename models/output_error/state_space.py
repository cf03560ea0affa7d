"""State-space models for the estimator: coordinates near a model, models to start from, a tidy form, poles."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from diffdrive_mpc.models.interface import AnyArray, FloatArray
from diffdrive_mpc.models.output_error.experiment import SampledExperiment

# A continuous linear system with dead time: how it is sampled, and its states under any drive.


_WHOLE = 1e-9


class LinearSystem(NamedTuple):
    """x' = A x + B limited(u(t - dead_time)), y = C x + offset; m inputs, p outputs. See `input_limits`.

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
    """(..., m, 4) in the order of `input_limits.KINDS`; inf where the robot takes every command"""


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
    """Discretise exactly, with zero-order hold and sample time `dt` [s]."""
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
    """Delay inputs (K, m): return the inputs of B0 and B1, each (m, K).

    Before sample 0 `before` (m,) was in force; by default the first row.
    """
    longest = int(delay.max()) + 1
    line = np.vstack([np.tile(inputs[0] if before is None else before, (longest, 1)), inputs])
    rows = np.arange(len(inputs)) + longest
    recent, older = ([line[rows - d - lag, j] for j, d in enumerate(delay)] for lag in (0, 1))
    return np.array(recent), np.array(older)


def settled_start(system: LinearSystem, outputs: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the settled state (n,) with output `outputs` (p,), and the input (m,) that holds it.

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
        """Simulate the states (n, S, K) at samples 0 to K - 1.

        Parameters
        ----------
        drive
            (n, S, K): S drives of K samples.
        start
            (n, S) states at sample 0; zero by default.
        """
        from scipy import signal  # noqa: PLC0415 - loads slowly, and loading a model does not need it

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


Realisation = tuple[FloatArray, FloatArray, FloatArray]
"""A (n, n), B (n, m), C (p, n), continuous."""
# Ridge on the impulse response, part of the inputs' power: held set-points hardly tell neighbouring samples apart.
_RIDGE = 1e-4
_FAINT = 0.05
_REAL = 1e-9


@dataclass(frozen=True)
class LocalStateSpace:
    """Every state-space model near a given one, each exactly once.

    A change of state coordinates moves A, B and C but not the outputs. The parameters run along the orthogonal
    complement of those moves: n (m + p) of them for n states, m inputs and p outputs (data driven local coordinates:
    McKelvey, Helmersson, Ribarits, Automatica 2004, 40(9), 1629-1635). No canonical form is needed, so poles may meet.

    Attributes
    ----------
    A, B, C
        (n, n), (n, m), (p, n): the model at parameters zero.
    """

    A: FloatArray
    B: FloatArray
    C: FloatArray
    basis: FloatArray = field(init=False)
    """(n (n + m + p), n (m + p)) orthonormal: from parameters to the entries of A, B and C."""

    def __post_init__(self) -> None:
        """Find the coordinates."""
        n = len(self.A)
        moves = []
        for unit in np.eye(n * n).reshape(-1, n, n):
            moves.append(
                np.concatenate(
                    [(self.A @ unit - unit @ self.A).ravel(), (-unit @ self.B).ravel(), (self.C @ unit).ravel()]
                )
            )
        left = np.linalg.svd(np.array(moves).T)[0]
        object.__setattr__(self, "basis", left[:, n * n :])

    @property
    def names(self) -> tuple[str, ...]:
        """Numbered: a local coordinate has no meaning of its own."""
        return tuple(f"coordinate_{i}" for i in range(self.basis.shape[1]))

    @property
    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """None."""
        free = np.full(self.basis.shape[1], np.inf)
        return -free, free

    def matrices(self, parameters: AnyArray) -> tuple[AnyArray, AnyArray, AnyArray]:
        """Return A (n, n), B (n, m), C (p, n)."""
        n, m = self.B.shape
        A, B, C = np.split(self.basis @ parameters, np.cumsum([n * n, n * m]))
        return self.A + A.reshape(n, n), self.B + B.reshape(n, m), self.C + C.reshape(-1, n)

    def recentred(self, parameters: FloatArray) -> tuple[LocalStateSpace, FloatArray]:
        """Return the coordinates around the model at `parameters`."""
        A, B, C = self.matrices(parameters)
        return LocalStateSpace(A, B, C), np.zeros_like(parameters)


def impulse_response(experiments: Sequence[SampledExperiment], dead_time: FloatArray, length: int) -> FloatArray:
    """Estimate the (p, m, length) impulse response behind dead times (m,) [s]; ridge regression on all experiments.

    Samples that do not count are interpolated: a start needs no more.
    """
    inputs, outputs = experiments[0].inputs.shape[1], experiments[0].outputs.shape[1]
    gram, moment = np.zeros((inputs * length,) * 2), np.zeros((inputs * length, outputs))
    for experiment in experiments:
        delay = np.floor(dead_time / experiment.dt).astype(np.int64)
        columns = [delayed(experiment.inputs, delay + lag)[1] for lag in range(length)]  # (m, K) each
        regressors = np.array(columns).reshape(length * inputs, -1)
        filled = np.column_stack([_filled(experiment, row) for row in range(outputs)])
        gram += regressors @ regressors.T
        moment += regressors @ filled
    gram += _RIDGE * np.trace(gram) / len(gram) * np.eye(len(gram))
    return np.asarray(np.linalg.solve(gram, moment).reshape(length, inputs, outputs).transpose(2, 1, 0))


def from_impulse_response(response: FloatArray, order: int, dt: float) -> Realisation | None:
    """Realise an impulse response (p, m, L); None without a stable realisation.

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
    """Return the model in balanced coordinates, each state with its largest output entry positive.

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
    """Add the outputs of two models in one realisation."""
    return (
        linalg.block_diag(first[0], second[0]),
        np.vstack([first[1], second[1]]),
        np.hstack([first[2], second[2]]),
    )


def spare_state(A: FloatArray, B: FloatArray, C: FloatArray) -> Realisation:
    """Return a weakly observable state, twice as fast as the fastest of a model: start value of a free state."""
    pole = 2.0 * np.abs(np.linalg.eigvals(A)).max()
    return (
        np.array([[-pole]]),
        _FAINT * np.abs(B).max(axis=0, keepdims=True),
        _FAINT * np.abs(C).max(axis=1, keepdims=True),
    )


def _filled(experiment: SampledExperiment, row: int) -> FloatArray:
    known = np.flatnonzero(experiment.counts[:, row])
    return np.asarray(np.interp(np.arange(experiment.samples), known, experiment.outputs[known, row]))


def distinct_poles(A: FloatArray) -> AnyArray:
    """Return eigenvalues [rad/s] of A (n, n) with non-negative imaginary part, slowest first."""
    poles = np.linalg.eigvals(A).astype(complex)
    poles = poles[poles.imag > -_REAL * np.abs(poles)]
    return np.asarray(poles[np.argsort(np.abs(poles), kind="stable")])


def pole_names(poles: AnyArray) -> list[str]:
    """Name the numbers of poles: pole_1, or pole_1.real and pole_1.imag, and so on."""
    return [name for i, pole in enumerate(poles) for name in _names(f"pole_{i + 1}", pole)]


def pole_numbers(A: FloatArray, near: AnyArray) -> FloatArray:
    """Return the numbers named by `pole_names(near)` for a matrix A whose poles are close to `near`."""
    poles = np.linalg.eigvals(A).astype(complex)
    numbers: list[float] = []
    for pole in near:
        nearest = poles[np.argmin(np.abs(poles - pole))]
        numbers += [nearest.real] if _is_real(pole) else [nearest.real, nearest.imag]
    return np.array(numbers)


def real_pole_names(names: Sequence[str]) -> list[str]:
    """Select those of `pole_names` that name a real pole."""
    return [name for name in names if name.startswith("pole_") and "." not in name]


def _names(name: str, pole: complex) -> list[str]:
    return [name] if _is_real(pole) else [f"{name}.real", f"{name}.imag"]


def _is_real(pole: complex) -> bool:
    return abs(pole.imag) <= _REAL * abs(pole)
