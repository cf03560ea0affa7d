"""State-space models for the estimator: simulation, local coordinates, initial models, balanced form and poles."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from diffdrive_mpc.models.interface import AnyArray, FloatArray
from diffdrive_mpc.models.output_error.experiment import SampledExperiment

# Continuous linear systems with dead time: discretisation and simulation.


_ROUNDING = 1e-9
"""Tolerance for dead times that are whole numbers of samples [samples]."""


class LinearSystem(NamedTuple):
    """System x' = A x + B limited(u(t - dead_time)), y = C x + offset with m inputs and p outputs.

    Leading dimensions are for stacks of systems. See `input_limits` for the limits.
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
    """(..., p) sensor offsets [units of the outputs]."""
    limit: AnyArray
    """(..., m, 4) limits in the order of `input_limits.KINDS`; inf if there is no limit."""


class SampledSystem(NamedTuple):
    """System x[k + 1] = A x[k] + B0 u[k - delay] + B1 u[k - delay - 1], as in `discrete_model.DiscreteModel`."""

    A: AnyArray
    """(..., n, n)"""
    B0: AnyArray
    """(..., n, m)"""
    B1: AnyArray
    """(..., n, m)"""
    delay: NDArray[np.int64]
    """(..., m) delay in whole samples."""


def sample(system: LinearSystem, dt: float) -> SampledSystem:
    """Discretise a system exactly with zero-order hold and sample time `dt` [s]."""
    n, m = system.B.shape[-2:]
    delay = np.floor(system.dead_time.real / dt + _ROUNDING).astype(np.int64)
    active_time = dt - (system.dead_time - delay * dt)
    # With constant inputs as extra states, one exponential contains sampled A and B (Van Loan, IEEE TAC 23(3), 1978).
    block = np.zeros((*system.A.shape[:-2], n + m, n + m), dtype=system.A.dtype)
    block[..., :n, :] = np.concatenate([system.A, system.B], axis=-1)
    full = linalg.expm(block * dt)
    parts = linalg.expm(block[..., None, :, :] * active_time[..., :, None, None])
    B0 = np.stack([parts[..., j, :n, n + j] for j in range(m)], axis=-1)
    return SampledSystem(full[..., :n, :n], B0, full[..., :n, n:] - B0, delay)


def delay_inputs(
    inputs: FloatArray, delay: NDArray[np.int64], before: FloatArray | None = None
) -> tuple[FloatArray, FloatArray]:
    """Delay inputs (..., K, m) and return the inputs of B0 and B1, each (m, ..., K).

    The inputs before sample 0 are `before` (..., m), by default the first row.
    """
    padding = int(delay.max()) + 1
    first = inputs[..., 0, :] if before is None else before
    padded = np.concatenate([np.repeat(first[..., None, :], padding, axis=-2), inputs], axis=-2)
    rows = np.arange(inputs.shape[-2]) + padding
    recent, older = ([padded[..., rows - d - lag, j] for j, d in enumerate(delay)] for lag in (0, 1))
    return np.array(recent), np.array(older)


def steady_start(system: LinearSystem, outputs: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the steady state (n,) with the outputs `outputs` (p,), and its constant input (m,).

    If there are fewer inputs than outputs, the result is the least-squares solution.
    """
    steady_states = -np.linalg.solve(system.A, system.B)
    inputs = np.linalg.lstsq(system.C @ steady_states, outputs - system.offset, rcond=None)[0]
    return np.asarray(steady_states @ inputs), np.asarray(inputs)


class StateResponse:
    """Simulator of x[k + 1] = A x[k] + drive[k] for any number of drives.

    In Schur coordinates A is triangular, so each state is a first-order filter of its drive and the states after it.
    Unlike a diagonal form, this is exact for equal poles.

    Parameters
    ----------
    A
        (n, n) matrix of the sampled system.
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
            (n, S, K) S drives of K samples.
        start
            (n, S) states at sample 0; zero by default.
        """
        from scipy import signal  # noqa: PLC0415 - slow import, not needed to load a model

        adjoint, triangle = self._basis.conj().T, self._triangle
        states = np.tensordot(adjoint, drive, 1)
        first = np.tensordot(adjoint, np.zeros(drive.shape[:2]) if start is None else start, 1)
        for i in reversed(range(len(states))):
            for j in range(i + 1, len(states)):
                if triangle[i, j] != 0.0:
                    states[i] += triangle[i, j] * states[j]
            # The initial condition of lfilter is the state at sample 0.
            states[i] = signal.lfilter([0.0, 1.0], [1.0, -triangle[i, i]], states[i], zi=first[i][:, None])[0]
        return np.asarray(np.tensordot(self._basis, states, 1).real)


Realisation = tuple[FloatArray, FloatArray, FloatArray]
"""A (n, n), B (n, m), C (p, n) of a continuous system."""
# Ridge parameter of the impulse response relative to the power of the inputs, because held set-points hardly
# distinguish adjacent samples.
_RIDGE = 1e-4
# Gains of a spare state relative to those of the model.
_SPARE_GAIN = 0.05
# Maximum relative imaginary part of a real pole.
_REAL_TOLERANCE = 1e-9


@dataclass(frozen=True)
class LocalStateSpace:
    """Minimal parametrisation of the state-space models near a given model.

    Changes of state coordinates change A, B and C but not the outputs. The parameters span the orthogonal complement of
    these changes: n (m + p) parameters for n states, m inputs and p outputs (data driven local coordinates: McKelvey,
    Helmersson, Ribarits, Automatica 2004, 40(9), 1629-1635). No canonical form is needed, so equal poles are permitted.

    Attributes
    ----------
    A, B, C
        (n, n), (n, m), (p, n) matrices of the model at zero parameters.
    """

    A: FloatArray
    B: FloatArray
    C: FloatArray
    basis: FloatArray = field(init=False)
    """(n (n + m + p), n (m + p)) orthonormal map from parameters to the entries of A, B and C."""

    def __post_init__(self) -> None:
        """Compute the basis of the coordinates."""
        n = len(self.A)
        units = np.eye(n * n).reshape(-1, n, n)
        changes = (self.A @ units - units @ self.A, -units @ self.B, self.C @ units)
        left = np.linalg.svd(np.concatenate([change.reshape(n * n, -1) for change in changes], axis=1).T)[0]
        object.__setattr__(self, "basis", left[:, n * n :])

    @property
    def names(self) -> tuple[str, ...]:
        """Numbered names, because a single local coordinate has no physical meaning."""
        return tuple(f"coordinate_{i}" for i in range(self.basis.shape[1]))

    @property
    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Infinite bounds."""
        infinite = np.full(self.basis.shape[1], np.inf)
        return -infinite, infinite

    def matrices(self, parameters: AnyArray) -> tuple[AnyArray, AnyArray, AnyArray]:
        """Return A (n, n), B (n, m), C (p, n)."""
        n, m = self.B.shape
        A, B, C = np.split(self.basis @ parameters, np.cumsum([n * n, n * m]))
        return self.A + A.reshape(n, n), self.B + B.reshape(n, m), self.C + C.reshape(-1, n)

    def recentred(self, parameters: FloatArray) -> tuple[LocalStateSpace, FloatArray]:
        """Return coordinates with the model at `parameters` as the origin, and zero parameters."""
        A, B, C = self.matrices(parameters)
        return LocalStateSpace(A, B, C), np.zeros_like(parameters)


def impulse_response(experiments: Sequence[SampledExperiment], dead_time: FloatArray, length: int) -> FloatArray:
    """Estimate the impulse response (p, m, length) after dead times (m,) [s] by ridge regression on all experiments.

    Samples between readings are interpolated, which is sufficient for an initial guess.
    """
    inputs, outputs = experiments[0].inputs.shape[1], experiments[0].outputs.shape[1]
    gram, moment = np.zeros((inputs * length,) * 2), np.zeros((inputs * length, outputs))
    for experiment in experiments:
        delay = np.floor(dead_time / experiment.dt).astype(np.int64)
        columns = [delay_inputs(experiment.inputs, delay + lag)[1] for lag in range(length)]  # (m, K) each
        regressors = np.array(columns).reshape(length * inputs, -1)
        interpolated = np.column_stack([_interpolated(experiment, row) for row in range(outputs)])
        gram += regressors @ regressors.T
        moment += regressors @ interpolated
    gram += _RIDGE * np.trace(gram) / len(gram) * np.eye(len(gram))
    return np.asarray(np.linalg.solve(gram, moment).reshape(length, inputs, outputs).transpose(2, 1, 0))


def from_impulse_response(response: FloatArray, order: int, dt: float) -> Realisation | None:
    """Realise an impulse response (p, m, L); return None if there is no stable realisation.

    Eigensystem realization algorithm: Juang, Pappa, Journal of Guidance, Control, and Dynamics 1985, 8(5), 620-627.
    """
    import control  # noqa: PLC0415 - slow import, needed for an SSM only

    # The first element is the direct feedthrough, which is zero.
    padded = np.concatenate([np.zeros_like(response[..., :1]), response], axis=-1)
    # With dt=True the impulse has unit height; a numeric sample time would scale it to unit area.
    system, _ = control.eigensys_realization(padded, order, dt=True)
    poles = np.linalg.eigvals(system.A)
    # A pole on the negative real axis has no continuous counterpart of the same order.
    if np.any(np.abs(poles) >= 1) or np.any((poles.real <= 0) & (np.abs(poles.imag) < 1e-9)):
        return None
    A = linalg.logm(system.A) / dt
    B = np.linalg.solve(system.A - np.eye(order), A @ system.B)
    return balance(np.real(A), np.real(B), np.asarray(system.C))


def balance(A: FloatArray, B: FloatArray, C: FloatArray) -> Realisation:
    """Return the model in balanced coordinates; the entry of C with the largest magnitude is positive for each state.

    Source: Moore, IEEE Transactions on Automatic Control 1981, 26(1), 17-32. A model that is not controllable and
    observable is returned unchanged.
    """
    controllability = linalg.solve_continuous_lyapunov(A, -B @ B.T)
    observability = linalg.solve_continuous_lyapunov(A.T, -C.T @ C)
    try:
        factor, weight = np.linalg.cholesky(controllability), np.linalg.cholesky(observability)
    except np.linalg.LinAlgError:
        return A, B, C
    # Square-root algorithm: the singular values of this product are the Hankel singular values.
    left, values, right = np.linalg.svd(weight.T @ factor)
    transform = (left / np.sqrt(values)).T @ weight.T
    inverse = factor @ (right.T / np.sqrt(values))
    A, B, C = transform @ A @ inverse, transform @ B, C @ inverse
    # Balanced coordinates are unique up to the sign of each state.
    sign = np.sign(C[np.argmax(np.abs(C), axis=0), np.arange(len(A))])
    return A * np.outer(sign, sign), B * sign[:, None], C * sign


def parallel(first: Realisation, second: Realisation) -> Realisation:
    """Return the parallel connection of two models, with the sum of their outputs."""
    return (linalg.block_diag(first[0], second[0]), np.vstack([first[1], second[1]]), np.hstack([first[2], second[2]]))


def spare_state(A: FloatArray, B: FloatArray, C: FloatArray) -> Realisation:
    """Return a state with small gains, twice as fast as the fastest pole of a model, to initialise a higher order."""
    pole = 2.0 * np.abs(np.linalg.eigvals(A)).max()
    return (
        np.array([[-pole]]),
        _SPARE_GAIN * np.abs(B).max(axis=0, keepdims=True),
        _SPARE_GAIN * np.abs(C).max(axis=1, keepdims=True),
    )


def _interpolated(experiment: SampledExperiment, row: int) -> FloatArray:
    known = np.flatnonzero(experiment.counts[:, row])
    return np.asarray(np.interp(np.arange(experiment.samples), known, experiment.outputs[known, row]))


def distinct_poles(A: FloatArray) -> AnyArray:
    """Return the eigenvalues [rad/s] of A (n, n) with non-negative imaginary part, slowest first."""
    poles = np.linalg.eigvals(A).astype(complex)
    poles = poles[poles.imag > -_REAL_TOLERANCE * np.abs(poles)]
    return np.asarray(poles[np.argsort(np.abs(poles), kind="stable")])


def pole_names(poles: AnyArray) -> list[str]:
    """Return the names of the real numbers that describe poles: pole_1, or pole_1.real and pole_1.imag if complex."""
    return [name for i, pole in enumerate(poles) for name in _names(f"pole_{i + 1}", pole)]


def pole_numbers(A: FloatArray, nominal: AnyArray) -> FloatArray:
    """Return the real numbers named by `pole_names(nominal)` for a matrix A with poles close to `nominal`."""
    poles = np.linalg.eigvals(A).astype(complex)
    numbers: list[float] = []
    for pole in nominal:
        nearest = poles[np.argmin(np.abs(poles - pole))]
        numbers += [nearest.real] if _is_real(pole) else [nearest.real, nearest.imag]
    return np.array(numbers)


def real_pole_names(names: Sequence[str]) -> list[str]:
    """Return the names of real poles in `names`."""
    return [name for name in names if name.startswith("pole_") and "." not in name]


def _names(name: str, pole: complex) -> list[str]:
    return [name] if _is_real(pole) else [f"{name}.real", f"{name}.imag"]


def _is_real(pole: complex) -> bool:
    return abs(pole.imag) <= _REAL_TOLERANCE * abs(pole)
