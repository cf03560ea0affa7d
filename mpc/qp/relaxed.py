"""The condensed problem without its limits: a factor and the minimiser."""

from __future__ import annotations

import numpy as np
from scipy.linalg import lapack

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.mpc.quadratic_program import QuadraticProgram, Relaxed
from diffdrive_mpc.mpc.solver_report import SolverStatus

# Numbers beyond this are no robot's, and OSQP takes bounds beyond 1e30 for none.
_LARGEST = 1e15


def relax(qp: QuadraticProgram) -> Relaxed | SolverStatus:
    """Minimise without limits, or say what is wrong with the data."""
    if not all(_is_sound(data) for data in (qp.H, qp.g, qp.box, qp.last_command, qp.soft_upper)):
        return SolverStatus.NOT_FINITE
    factor, failed = lapack.dpotrf(qp.H.T, lower=1, clean=1)
    if failed:
        return SolverStatus.NOT_CONVEX
    negative, _ = lapack.dpotrs(factor, qp.g, lower=1)
    residual = float(np.abs(qp.g - qp.H @ negative).max())
    return Relaxed(-negative, factor, residual, qp.broken(-negative, 0.0))


def inverse_factor(factor: FloatArray) -> FloatArray:
    """(2 N, 2 N) inverse of L', upper triangular, rows contiguous."""
    inverse, _ = lapack.dtrtri(factor, lower=1)
    return inverse.T  # type: ignore[no-any-return]


def _is_sound(data: FloatArray) -> bool:
    """Whether no number is NaN, infinite or larger than any robot's; one pass, without a temporary."""
    flat = data.reshape(-1)
    return bool(flat @ flat < _LARGEST**2)
