"""The condensed problem without its limits: a factor and the minimiser."""

from __future__ import annotations

from dataclasses import dataclass

from scipy.linalg import lapack

from models.interface import FloatArray
from mpc.quadratic_program import QuadraticProgram


@dataclass(frozen=True, slots=True)
class Relaxed:
    """Minimiser of U'HU/2 + g'U, and the factor of H = L L' that gave it.

    Attributes
    ----------
    plan
        (2 N,) the minimiser.
    factor
        (2 N, 2 N) L, lower triangular, columns contiguous.
    """

    plan: FloatArray
    factor: FloatArray


def relax(qp: QuadraticProgram) -> Relaxed | None:
    """Minimise without limits; None where H is not positive definite."""
    factor, failed = lapack.dpotrf(qp.H.T, lower=1, clean=1)
    if failed:
        return None
    negative, _ = lapack.dpotrs(factor, qp.g, lower=1)
    return Relaxed(-negative, factor)


def inverse_factor(factor: FloatArray) -> FloatArray:
    """(2 N, 2 N) inverse of L', upper triangular, rows contiguous."""
    inverse, _ = lapack.dtrtri(factor, lower=1)
    return inverse.T  # type: ignore[no-any-return]
