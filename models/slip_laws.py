"""Slip laws of the papers: twist of the body on a surface as a function of the twist of its wheels."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from diffdrive_mpc.models.interface import FloatArray

POLYNOMIAL = tuple(f"a{row}{column}" for row in (1, 2, 3) for column in (1, 2, 3))
"""Names of the nine coefficients of `polynomial_twist`, row by row."""

# Minimum argument of the square root for a shrinking track; the law has no solution below 0 and no finite slope at 0.
_MIN_RADICAND = 0.04


def polynomial_twist(coefficients: ArrayLike, wheels: ArrayLike) -> FloatArray:
    """Compute the twist of the body: twist (v_c, w_c) of the wheels plus terms in v_c, w_c and v_c w_c.

    Source: Ordonez et al., 2017 (P4): v = v_c + a11 v_c + a12 w_c + a13 v_c w_c, lateral = a21 v_c + a22 w_c +
    a23 v_c w_c, omega = w_c + a31 v_c + a32 w_c + a33 v_c w_c. Here lateral is to the left and w_c counter-clockwise.

    Parameters
    ----------
    coefficients
        (3, 3), or (9,) row by row.
    wheels
        (..., 2) v_c [m/s], w_c [rad/s].

    Returns
    -------
    FloatArray
        (..., 3) forward speed, lateral speed to the left [m/s], yaw rate [rad/s].
    """
    v, omega = np.moveaxis(np.asarray(wheels, dtype=float), -1, 0)
    return np.stack(polynomial_terms(np.asarray(coefficients, dtype=float).reshape(3, 3), v, omega), axis=-1)


def polynomial_terms(
    coefficients: FloatArray,
    v: Any,  # noqa: ANN401 - arrays or CasADi's symbols
    omega: Any,  # noqa: ANN401
) -> tuple[Any, Any, Any]:
    """Compute the three components of `polynomial_twist` for numbers or symbols; coefficients are (3, 3)."""
    ahead, left, turn = (a * v + b * omega + c * v * omega for a, b, c in coefficients.tolist())
    return v + ahead, left, omega + turn


def track_widening(settled: Any, growth: Any) -> Any:  # noqa: ANN401 - numbers, arrays or symbols
    """Compute the ratio of the track to the track at rest [-] with CasADi; the track depends on the yaw rate.

    The law i = p1 |omega| + p0 becomes k = 1 + growth |omega| with growth = p1 / p0 and omega = settled / k. This
    equation is quadratic in k; its solution with k = 1 for growth = 0 is used. For a shrinking track, k has a lower
    bound, because faster turns have no solution.

    Source: Botta et al., Appl. Sci. 2021, 11(4), 1594 (P3).

    Parameters
    ----------
    settled
        Yaw rate with the track at rest [rad/s]; the robot's yaw rate is this value over the ratio.
    growth
        Relative growth of the track per yaw rate of the robot, p1 / p0 [s/rad].
    """
    return 0.5 * (1 + ca.sqrt(ca.fmax(1 + 4 * growth * ca.fabs(settled), _MIN_RADICAND)))


def virtual_track_yaw_rate(difference: ArrayLike, p0: float, p1: float) -> FloatArray:
    """Compute the yaw rate of a robot whose track grows with the yaw rate, i = p1 |yaw rate| + p0.

    Source: Botta et al., Appl. Sci. 2021, 11(4), 1594 (P3). yaw rate = difference / i is quadratic in the yaw rate; the
    solution that is finite for p1 = 0 is used.

    Parameters
    ----------
    difference
        (...) rim speed of the right wheels minus rim speed of the left wheels [m/s].
    p0, p1
        Track at rest [m] and its growth [m s].

    Returns
    -------
    FloatArray
        (...) yaw rate [rad/s].
    """
    settled = np.asarray(difference, dtype=float) / p0
    return settled / np.reshape(track_widening(settled.ravel(), p1 / p0), settled.shape)
