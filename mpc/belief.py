"""What the extended Kalman filter believes: a mean and how far it can be trusted."""

from __future__ import annotations

from typing import NamedTuple

from models.interface import FloatArray


class Belief(NamedTuple):
    """Mean (n + 9,) and covariance (n + 9, n + 9) of the filter's state."""

    mean: FloatArray
    covariance: FloatArray


def corrected(mean: FloatArray, P: FloatArray, gain: FloatArray, PHt: FloatArray, S: FloatArray) -> Belief:
    """Belief after a correction with any gain, optimal or not (Joseph's form)."""
    step = gain @ PHt.T
    P = P - step - step.T + gain @ S @ gain.T
    return Belief(mean, 0.5 * (P + P.T))
