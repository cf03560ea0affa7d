"""How well parameters are known when residuals are correlated in time, as those of a simulation are.

Covariance H^-1 S H^-1 ("sandwich"): H is the information that white residuals would give, S the long-run covariance of
the scores. Sources: Ljung, System Identification, 2nd edition, 1999, section 9.4 (output error with coloured noise);
Newey, West, Econometrica 1987, 55(3), 703-708 (weights of the lags); Andrews, Econometrica 1991, 59(3), 817-858
(how many lags).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from diffdrive_mpc.models.interface import FloatArray

# Correlations of scores are capped here in the choice of the window: beyond, the window would take in everything.
_MOST_CORRELATED = 0.97


class Sandwich(NamedTuple):
    """Covariance and what it says about the data."""

    covariance: FloatArray
    """(q, q)"""
    effective_samples: FloatArray
    """(p,) independent readings that the residuals are worth"""
    condition: float
    """condition number of the information matrix, scaled to unit diagonal"""


def sandwich(jacobians: Sequence[FloatArray], errors: Sequence[FloatArray]) -> Sandwich:
    """Covariance of parameters at the optimum of a weighted least-squares problem.

    Parameters
    ----------
    jacobians
        For each stretch (K, p, q) derivatives of the weighted residuals, initial states projected out.
    errors
        For each stretch (K, p) weighted residuals, NaN where they do not count.
    """
    count = jacobians[0].shape[2]
    rows = [jacobian.reshape(-1, count) for jacobian in jacobians]
    information = np.sum([row.T @ row for row in rows], axis=0)
    scores = [
        np.einsum("kpq,kp->kq", j, np.nan_to_num(e), optimize=True) for j, e in zip(jacobians, errors, strict=True)
    ]
    spread = np.sqrt(np.maximum(np.diag(information), np.finfo(float).tiny))
    shaped = information / np.outer(spread, spread)
    bread = np.linalg.pinv(shaped, rcond=1e-14, hermitian=True) / np.outer(spread, spread)
    used = sum(int(np.isfinite(error).sum()) for error in errors)
    covariance = bread @ long_run_covariance(scores) @ bread * used / max(used - count, 1)
    return Sandwich(covariance, effective_samples(errors), float(np.linalg.cond(shaped)))


def long_run_covariance(scores: Sequence[FloatArray], window: int | None = None) -> FloatArray:
    """(q, q) covariance of the scores' (K, q) sum, Bartlett weights.

    Nothing is correlated across stretches. The window is chosen from the scores' first autocorrelation (Andrews' rule
    for Bartlett weights) unless given.
    """
    if window is None:
        window = _window(scores)
    total = np.zeros((scores[0].shape[1],) * 2)
    for row in scores:
        total += row.T @ row
        for lag in range(1, min(window + 1, len(row))):
            part = row[lag:].T @ row[:-lag]
            total += (1 - lag / (window + 1)) * (part + part.T)
    return total


def effective_samples(errors: Sequence[FloatArray]) -> FloatArray:
    """(p,) readings divided by the integrated autocorrelation of the residuals (K, p), NaN where they do not count."""
    worth = []
    for row in range(errors[0].shape[1]):
        column = [np.nan_to_num(error[:, row : row + 1]) for error in errors]
        used = sum(int(np.isfinite(error[:, row]).sum()) for error in errors)
        power = sum(float((c**2).sum()) for c in column)
        inflation = float(long_run_covariance(column)[0, 0]) / power if power else 1.0
        worth.append(used / max(inflation, 1.0))
    return np.array(worth)


def _window(scores: Sequence[FloatArray]) -> int:
    """Lags that count: 1.1447 (4 rho^2 / (1 - rho^2)^2 K)^(1/3), rho the strongest autocorrelation of any score."""
    power = sum((row**2).sum(axis=0) for row in scores)
    lagged = sum((row[1:] * row[:-1]).sum(axis=0) for row in scores)
    rho = np.abs(lagged / np.maximum(power, np.finfo(float).tiny)).max()
    rho = min(rho, _MOST_CORRELATED)
    samples = sum(map(len, scores))
    return int(1.1447 * (4 * rho**2 / (1 - rho**2) ** 2 * samples) ** (1 / 3))
