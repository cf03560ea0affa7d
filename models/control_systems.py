"""Velocity models from systems of python-control, and back."""

from __future__ import annotations

import warnings
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import block_diag, expm, logm

from diffdrive_mpc.models.errors import wrong_type
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.velocity_model import CHANNELS, ModelError, VelocityModel

_ZERO = 1e-12
"""Poles of a discrete system below this share of its norm are delays."""
_ROUNDING = 1e-14
"""Numerators of a discrete system below this are zero."""
_SAME = 1e-9
"""Impulse responses agree within this share of their largest value."""
_REMEDY = "give a 2x2 control.TransferFunction or control.StateSpace, or two single-input ones for v and omega"


class _StateSpace(NamedTuple):
    """x' = A x + B u, y = C x; or x[k+1] where `dt` is above 0 [s]."""

    A: FloatArray
    B: FloatArray
    C: FloatArray
    dt: float


def from_control(system: Any, dead_time: ArrayLike, name: str | None) -> VelocityModel:  # noqa: ANN401 - untyped package
    """Make the model of `VelocityModel.from_control`."""
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
        A, B, C, delay = _continuous(where, _StateSpace(A, B, C, spaces[0].dt))
    try:
        late = np.asarray(dead_time, dtype=float)
    except (TypeError, ValueError) as error:
        raise wrong_type("dead_time", "seconds", dead_time, "give 0.1, or (0.06, 0.04) for v and omega") from error
    if late.shape not in ((), (2,)):
        raise ModelError(f"{where}: dead_time has shape {late.shape}; give seconds for v and for omega")
    source = {"origin": "python-control", "source": where}
    return VelocityModel(label, "sm" if is_pair else "ssm", A, B, C, delay + late, source)


def to_control(model: VelocityModel, dt: float | None) -> Any:  # noqa: ANN401 - untyped package
    """Make the system of `VelocityModel.to_control`."""
    import control  # noqa: PLC0415 - loads slowly, and matplotlib with it

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
        # States are past commands of this input, newest first, after the command itself.
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
    """State space of a system with `size` inputs and outputs."""
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
        A, B, C, D = _realised(where, system)
    if np.abs(D).max(initial=0.0) > _ZERO:
        raise ModelError(
            f"{where}: its output jumps with its input (D = {np.abs(D).max():.3g}), which no robot's speed does; "
            "give numerators of lower degree than the denominators"
        )
    return _StateSpace(A, B, C, float(system.dt or 0.0))


def _realised(where: str, system: Any) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:  # noqa: ANN401
    """Realise a transfer function as A, B, C, D; outputs with one denominator share the states of their input."""
    blocks, inputs, outputs = [], [], []
    D = np.zeros((system.noutputs, system.ninputs))
    # Coefficients in z are of order one: smaller ones are rounding errors of a conversion.
    least = _ROUNDING if system.dt else 0.0
    for j in range(system.ninputs):
        shared: dict[tuple[float, ...], FloatArray] = {}
        for i in range(system.noutputs):
            numerator, denominator = _cancelled(*(np.real(side[i][j]) for side in (system.num, system.den)))
            n = len(denominator) - 1
            if len(numerator) > n + 1:
                raise ModelError(f"{where}: a numerator of higher degree than its denominator cannot be a robot's")
            numerator = np.pad(numerator, (n + 1 - len(numerator), 0)) / denominator[0]
            denominator = denominator / denominator[0]
            D[i, j] = numerator[0]
            if np.abs(numerator).max() > least and n:
                rows = shared.setdefault(tuple(denominator), np.zeros((system.noutputs, n)))
                rows[i] = (numerator - numerator[0] * denominator)[1:]
        for coefficients, rows in shared.items():
            n = len(coefficients) - 1
            blocks.append(np.vstack([-np.array(coefficients[1:]), np.eye(n)[:-1]]))
            inputs.append(np.outer(np.eye(n)[0], np.eye(system.ninputs)[j]))
            outputs.append(rows)
    if not blocks:
        raise ModelError(f"{where}: all its transfer functions are constant; a robot's speed follows with a lag")
    return block_diag(*blocks), np.vstack(inputs), np.hstack(outputs), D


def _cancelled(numerator: FloatArray, denominator: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Cancel leading zeros and common factors z (or s) of the coefficients."""
    both = [np.trim_zeros(side, "f") for side in (numerator, denominator)]
    common = min(len(side) - len(np.trim_zeros(side, "b")) for side in both)
    return both[0][: len(both[0]) - common], both[1][: len(both[1]) - common]


def _continuous(where: str, sampled: _StateSpace) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return A, B, C of the continuous system with this zero-order-hold sampling, and its dead time (2,) [s]."""
    count = 2 * len(sampled.A) + 2
    response = _impulse_response(sampled.A, sampled.B, sampled.C, count)
    size = np.abs(response).max()
    answered = (np.abs(response) > _ZERO * size).any(axis=1)
    if not answered.any(axis=0).all():
        raise ModelError(f"{where}: an input moves no output")
    delay = answered.argmax(axis=0)
    A, B, C = _without_delays(sampled, delay)
    poles = np.linalg.eigvals(A)
    worst = poles[np.argmax(np.abs(poles))] if poles.size else 1.0
    if not abs(worst) < 1:
        raise ModelError(f"{where}: unstable, pole at z = {worst:.4g}; every pole must lie inside the unit circle")
    negative = poles[(poles.imag == 0) & (poles.real < 0)]
    if negative.size:
        raise ModelError(
            f"{where}: pole at z = {negative[0].real:.4g}; no continuous system has a negative one under a "
            "zero-order hold: identify it again, with a lower order"
        )
    with warnings.catch_warnings():
        # Results of an inaccurate logarithm are rejected below.
        warnings.simplefilter("ignore", RuntimeWarning)
        continuous = np.real(logm(A)) / sampled.dt
    B = np.linalg.solve(A - np.eye(len(A)), continuous @ B)
    n = len(A)
    again = expm(np.block([[continuous, B], [np.zeros((2, n + 2))]]) * sampled.dt)
    undelayed = _impulse_response(again[:n, :n], again[:n, n:], C, count)
    for j in (0, 1):
        late = np.pad(undelayed[..., j], ((int(delay[j]), 0), (0, 0)))[:count]
        if np.abs(late - response[..., j]).max() > _SAME * size:
            raise ModelError(
                f"{where}: its poles at or near z = 0 are no delay of whole samples, the same for both outputs; give "
                "the continuous system, and dead_time="
            )
    return continuous, B, C, delay * sampled.dt


def _without_delays(sampled: _StateSpace, delay: NDArray[np.int64]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return A, B, C of the system whose inputs act `delay` (2,) samples earlier, without delay states."""
    A, Q, n = sampled.A.copy(), np.eye(len(sampled.A)), len(sampled.A)
    least = _ZERO * np.linalg.norm(A)
    k = 0
    while k < n:
        # States that no other state drives are pending commands: each round removes one sample of delay.
        left, singular, _ = np.linalg.svd(A[k:, k:])
        rank = int((singular > least).sum())
        if rank == n - k:
            break
        turn = np.hstack([left[:, rank:], left[:, :rank]])
        A[:, k:] = A[:, k:] @ turn
        A[k:] = turn.T @ A[k:]
        Q[:, k:] = Q[:, k:] @ turn
        k = n - rank
    arrived = [np.linalg.matrix_power(sampled.A, int(late)) @ b for late, b in zip(delay, sampled.B.T, strict=True)]
    return A[k:, k:], Q[:, k:].T @ np.column_stack(arrived), sampled.C @ Q[:, k:]


def _impulse_response(A: FloatArray, B: FloatArray, C: FloatArray, count: int) -> FloatArray:
    """Compute (count, 2, 2) values of the impulse response from sample 1 on."""
    values = np.empty((count, 2, 2))
    for k in range(count):
        values[k] = C @ B
        B = A @ B
    return values
