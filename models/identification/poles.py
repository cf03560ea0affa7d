"""Poles as named numbers: one for a real pole, two for a complex pair."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from diffdrive_mpc.models.identification.output_error.linear_system import AnyArray
from diffdrive_mpc.models.interface import FloatArray

_REAL = 1e-9


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
