"""Conversion between velocity models and systems of python-control."""

from __future__ import annotations

import warnings
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import block_diag, expm, logm

from diffdrive_mpc.models.errors import wrong_type
from diffdrive_mpc.models.interface import FloatArray, checked_array
from diffdrive_mpc.models.velocity_model import CHANNELS, ModelError, VelocityModel

_ZERO = 1e-12
"""Share of its norm below which poles of a discrete system count as delays."""
_ROUNDING = 1e-14
"""Coefficient below which a numerator of a discrete system counts as zero."""
_SAME = 1e-9
"""Relative tolerance of two impulse responses."""
_REMEDY = "give a 2x2 control.TransferFunction or control.StateSpace, or two single-input ones for v and omega"


class _StateSpace(NamedTuple):
    """x' = A x + B u, y = C x, with x[k+1] instead of x' if the sample time `dt` [s] is positive."""

    A: FloatArray
    B: FloatArray
    C: FloatArray
    dt: float


def from_control(system: Any, dead_time: ArrayLike, name: str | None) -> VelocityModel:  # noqa: ANN401 - untyped package
    """Implement `VelocityModel.from_control`."""
    is_pair = isinstance(system, (list, tuple)) and len(system) == 2
    parts = list(system) if is_pair else [system]
    label = name or str(getattr(parts[0], "name", "control")).removesuffix("$converted")
    where = f"system '{label}'"
    spaces = [_state_space(where, part, 1 if is_pair else 2) for part in parts]
    if len({space.dt for space in spaces}) > 1:
        raise ModelError(f"{where}: sample times {spaces[0].dt:g} and {spaces[1].dt:g} s differ; give both the same")
    A, B, C = (block_diag(*(space[i] for space in spaces)) for i in range(3))
    delay = np.zeros(2)
    if spaces[0].dt:
        A, B, C, delay = _continuous_system(where, _StateSpace(A, B, C, spaces[0].dt))
    extra_delay = checked_array("dead_time", dead_time, "seconds", "give 0.1, or (0.06, 0.04) for v and omega")
    if extra_delay.shape not in ((), (2,)):
        raise ModelError(f"{where}: dead_time has shape {extra_delay.shape}; give seconds for v and for omega")
    source = {"origin": "python-control", "source": where}
    return VelocityModel(label, "sm" if is_pair else "ssm", A, B, C, delay + extra_delay, source)


def to_control(model: VelocityModel, dt: float | None) -> Any:  # noqa: ANN401 - untyped package
    """Implement `VelocityModel.to_control`."""
    import control  # noqa: PLC0415 - loads slowly, with matplotlib

    labels: dict[str, Any] = {
        "inputs": [f"{channel}_ref" for channel in CHANNELS],
        "outputs": list(CHANNELS),
        "name": model.name,
    }
    if dt is None:
        return control.ss(model.A, model.B, model.C, np.zeros((2, 2)), **labels)
    sampled = model.discretise(dt)
    n = sampled.order
    lengths = [int(delay) + bool(older.any()) for delay, older in zip(sampled.delay, sampled.B1.T, strict=True)]
    A, B = block_diag(sampled.A, *(np.eye(length, k=-1) for length in lengths)), np.zeros((n + sum(lengths), 2))
    first = n
    for j, length in enumerate(lengths):
        # The additional states are past commands of this input, newest first. The current command, of age 0, is an
        # input instead of a state.
        for age, column in ((int(sampled.delay[j]), sampled.B0[:, j]), (int(sampled.delay[j]) + 1, sampled.B1[:, j])):
            if age == 0:
                B[:n, j] += column
            elif age <= length:
                A[:n, first + age - 1] += column
        if length:
            B[first, j] = 1.0
        first += length
    return control.ss(A, B, np.pad(sampled.C, ((0, 0), (0, sum(lengths)))), np.zeros((2, 2)), dt, **labels)


def _state_space(where: str, system: Any, size: int) -> _StateSpace:  # noqa: ANN401
    """Return the state space of a system with `size` inputs and outputs; raise ModelError if it is unsuitable."""
    kind = type(system).__name__ if type(system).__module__.partition(".")[0] == "control" else ""
    if kind not in ("TransferFunction", "StateSpace"):
        raise wrong_type("VelocityModel.from_control", "a linear system of python-control", system, _REMEDY)
    if (system.noutputs, system.ninputs) != (size, size):
        raise ModelError(f"{where}: {system.noutputs} outputs and {system.ninputs} inputs; {_REMEDY}")
    if system.dt is True:
        raise ModelError(f"{where}: a discrete system without a sample time; give it dt in s")
    if kind == "StateSpace":
        A, B, C, D = (np.array(getattr(system, matrix), dtype=float) for matrix in "ABCD")
    else:
        A, B, C, D = _realise(where, system)
    if np.abs(D).max(initial=0.0) > _ZERO:
        raise ModelError(
            f"{where}: the output jumps with the input (D = {np.abs(D).max():.3g}), unlike the speed of a robot; "
            "give numerators of lower degree than the denominators"
        )
    return _StateSpace(A, B, C, float(system.dt or 0.0))


def _realise(where: str, system: Any) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:  # noqa: ANN401
    """Realise a transfer function as A, B, C, D; outputs with equal denominators share the states of their input."""
    blocks, inputs, outputs = [], [], []
    D = np.zeros((system.noutputs, system.ninputs))
    # Coefficients in z are of order one; much smaller coefficients are rounding errors of a conversion.
    tolerance = _ROUNDING if system.dt else 0.0
    for j in range(system.ninputs):
        shared: dict[tuple[float, ...], FloatArray] = {}
        for i in range(system.noutputs):
            numerator, denominator = _cancel_common_factors(*(np.real(side[i][j]) for side in (system.num, system.den)))
            n = len(denominator) - 1
            if len(numerator) > n + 1:
                raise ModelError(f"{where}: a numerator has a higher degree than its denominator, unlike any robot")
            numerator = np.pad(numerator, (n + 1 - len(numerator), 0)) / denominator[0]
            denominator = denominator / denominator[0]
            D[i, j] = numerator[0]
            if np.abs(numerator).max() > tolerance and n:
                rows = shared.setdefault(tuple(denominator), np.zeros((system.noutputs, n)))
                rows[i] = (numerator - numerator[0] * denominator)[1:]
        for coefficients, rows in shared.items():
            n = len(coefficients) - 1
            blocks.append(np.vstack([-np.array(coefficients[1:]), np.eye(n)[:-1]]))
            inputs.append(np.outer(np.eye(n)[0], np.eye(system.ninputs)[j]))
            outputs.append(rows)
    if not blocks:
        raise ModelError(f"{where}: the transfer functions of '{system.name}' are constant; the speed of a robot lags")
    return block_diag(*blocks), np.vstack(inputs), np.hstack(outputs), D


def _cancel_common_factors(numerator: FloatArray, denominator: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Cancel leading zeros and common factors z (or s) of the coefficients."""
    both = [np.trim_zeros(side, "f") for side in (numerator, denominator)]
    common = min(len(side) - len(np.trim_zeros(side, "b")) for side in both)
    return both[0][: len(both[0]) - common], both[1][: len(both[1]) - common]


def _continuous_system(where: str, sampled: _StateSpace) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return A, B, C and dead time (2,) [s] of the continuous system whose zero-order-hold sampling is `sampled`."""
    # The impulse response of a system of order n is determined by 2 n values.
    count = 2 * len(sampled.A) + 2
    response = _impulse_response(sampled.A, sampled.B, sampled.C, count)
    size = np.abs(response).max()
    is_nonzero = (np.abs(response) > _ZERO * size).any(axis=1)
    if not is_nonzero.any(axis=0).all():
        raise ModelError(f"{where}: an input has no effect on any output; connect both inputs")
    delay = is_nonzero.argmax(axis=0)
    A, B, C = _remove_delays(sampled, delay)
    poles = np.linalg.eigvals(A)
    outermost = poles[np.argmax(np.abs(poles))] if poles.size else 1.0
    if not abs(outermost) < 1:
        raise ModelError(f"{where}: unstable, pole at z = {outermost:.4g}; every pole must lie inside the unit circle")
    negative = poles[(poles.imag == 0) & (poles.real < 0)]
    if negative.size:
        raise ModelError(
            f"{where}: pole at z = {negative[0].real:.4g}; no continuous system has a negative pole under a "
            "zero-order hold: identify the system again, with a lower order"
        )
    with warnings.catch_warnings(action="ignore", category=RuntimeWarning):
        # Results of an inaccurate logarithm are rejected below.
        continuous = np.real(logm(A)) / sampled.dt
    # Invert the zero-order hold.
    B = np.linalg.solve(A - np.eye(len(A)), continuous @ B)
    n = len(A)
    resampled = expm(np.block([[continuous, B], [np.zeros((2, n + 2))]]) * sampled.dt)
    # Compare with the original response, because logarithm and removal of delays may be inaccurate.
    undelayed = _impulse_response(resampled[:n, :n], resampled[:n, n:], C, count)
    for j in (0, 1):
        delayed = np.pad(undelayed[..., j], ((int(delay[j]), 0), (0, 0)))[:count]
        if np.abs(delayed - response[..., j]).max() > _SAME * size:
            raise ModelError(
                f"{where}: the poles at or near z = 0 do not represent a whole number of samples of delay of both "
                "outputs; give the continuous system, and dead_time="
            )
    return continuous, B, C, delay * sampled.dt


def _remove_delays(sampled: _StateSpace, delay: NDArray[np.int64]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return A, B, C of the system whose inputs act `delay` (2,) samples earlier, without delay states."""
    A, Q, n = sampled.A.copy(), np.eye(len(sampled.A)), len(sampled.A)
    tolerance = _ZERO * np.linalg.norm(A)
    k = 0
    while k < n:
        # States that are not driven by other states are pending commands; each round removes one sample of delay.
        left, singular, _ = np.linalg.svd(A[k:, k:])
        rank = int((singular > tolerance).sum())
        if rank == n - k:
            break
        basis = np.hstack([left[:, rank:], left[:, :rank]])
        A[:, k:] = A[:, k:] @ basis
        A[k:] = basis.T @ A[k:]
        Q[:, k:] = Q[:, k:] @ basis
        k = n - rank
    columns = [np.linalg.matrix_power(sampled.A, int(steps)) @ b for steps, b in zip(delay, sampled.B.T, strict=True)]
    return A[k:, k:], Q[:, k:].T @ np.column_stack(columns), sampled.C @ Q[:, k:]


def _impulse_response(A: FloatArray, B: FloatArray, C: FloatArray, count: int) -> FloatArray:
    """Compute the impulse response (count, 2, 2), starting at sample 1."""
    values = np.empty((count, 2, 2))
    for k in range(count):
        values[k] = C @ B
        B = A @ B
    return values
