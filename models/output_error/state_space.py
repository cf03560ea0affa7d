"""State-space models for the estimator: coordinates near a model, models to start from, a tidy form, poles."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy import linalg

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.output_error.experiment import Experiment
from diffdrive_mpc.models.output_error.linear_system import AnyArray, delayed

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
        """A (n, n), B (n, m), C (p, n)."""
        n, m = self.B.shape
        A, B, C = np.split(self.basis @ parameters, np.cumsum([n * n, n * m]))
        return self.A + A.reshape(n, n), self.B + B.reshape(n, m), self.C + C.reshape(-1, n)

    def recentred(self, parameters: FloatArray) -> tuple[LocalStateSpace, FloatArray]:
        """The coordinates around the model at `parameters`."""
        A, B, C = self.matrices(parameters)
        return LocalStateSpace(A, B, C), np.zeros_like(parameters)


def impulse_response(experiments: Sequence[Experiment], dead_time: FloatArray, length: int) -> FloatArray:
    """(p, m, length) sampled impulse response behind dead times (m,) [s], by ridge regression on all experiments.

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


def _filled(experiment: Experiment, row: int) -> FloatArray:
    known = np.flatnonzero(experiment.counts[:, row])
    return np.asarray(np.interp(np.arange(experiment.samples), known, experiment.outputs[known, row]))


def distinct_poles(A: FloatArray) -> AnyArray:
    """Eigenvalues [rad/s] of A (n, n) with no negative imaginary part, slowest first."""
    poles = np.linalg.eigvals(A).astype(complex)
    poles = poles[poles.imag > -_REAL * np.abs(poles)]
    return np.asarray(poles[np.argsort(np.abs(poles), kind="stable")])


def pole_names(poles: AnyArray) -> list[str]:
    """pole_1, or pole_1.real and pole_1.imag, and so on."""
    return [name for i, pole in enumerate(poles) for name in _names(f"pole_{i + 1}", pole)]


def pole_numbers(A: FloatArray, near: AnyArray) -> FloatArray:
    """The numbers behind `pole_names(near)` for a matrix A close to that of which `near` are the poles."""
    found = np.linalg.eigvals(A).astype(complex)
    numbers: list[float] = []
    for pole in near:
        nearest = found[np.argmin(np.abs(found - pole))]
        numbers += [nearest.real] if _is_real(pole) else [nearest.real, nearest.imag]
    return np.array(numbers)


def real_pole_names(names: Sequence[str]) -> list[str]:
    """Those of `pole_names` that stand for a real pole."""
    return [name for name in names if name.startswith("pole_") and "." not in name]


def _names(name: str, pole: complex) -> list[str]:
    return [name] if _is_real(pole) else [f"{name}.real", f"{name}.imag"]


def _is_real(pole: complex) -> bool:
    return abs(pole.imag) <= _REAL * abs(pole)
