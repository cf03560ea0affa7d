"""What a floor makes of the wheels' twist: the laws of the papers, each once."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from diffdrive_mpc.models.interface import FloatArray

POLYNOMIAL = tuple(f"a{row}{column}" for row in (1, 2, 3) for column in (1, 2, 3))
"""Names of the nine coefficients of `polynomial_twist`, row by row."""


def polynomial_twist(coefficients: ArrayLike, wheels: ArrayLike) -> FloatArray:
    """Twist of the body by terms in v_c, w_c and v_c w_c, added to the wheels' (v_c, w_c).

    Source: Ordonez et al., 2017 (P4): v = v_c + a11 v_c + a12 w_c + a13 v_c w_c, lateral = a21 v_c + a22 w_c +
    a23 v_c w_c, omega = w_c + a31 v_c + a32 w_c + a33 v_c w_c. Here lateral is to the left and w_c counter-clockwise.

    Parameters
    ----------
    coefficients
        (3, 3) or (9,), row by row.
    wheels
        (..., 2) v_c [m/s], w_c [rad/s].

    Returns
    -------
    FloatArray
        (..., 3) forward speed, lateral speed to the left [m/s], yaw rate [rad/s].
    """
    v, omega = np.moveaxis(np.asarray(wheels, dtype=float), -1, 0)
    terms = np.stack([v, omega, v * omega], axis=-1)
    rows = np.asarray(coefficients, dtype=float).reshape(3, 3)
    return np.asarray(np.stack([v, np.zeros_like(v), omega], axis=-1) + terms @ rows.T)


def virtual_track_yaw_rate(difference: ArrayLike, p0: float, p1: float) -> FloatArray:
    """Yaw rate of a robot whose track grows with it, i = p1 |yaw rate| + p0.

    Source: Botta et al., Appl. Sci. 2021, 11(4), 1594 (P3). yaw rate = difference / i is quadratic in the yaw rate; its
    solution that stays finite for p1 = 0 is used.

    Parameters
    ----------
    difference
        (...) rim speed of the right wheels less that of the left [m/s].
    p0, p1
        Track at rest [m] and its growth [m s].

    Returns
    -------
    FloatArray
        (...) yaw rate [rad/s].
    """
    difference = np.asarray(difference, dtype=float)
    # Below the root's range the law has no solution; its edge keeps a search finite.
    root = np.sqrt(np.maximum(p0**2 + 4 * p1 * np.abs(difference), 0.0))
    return np.asarray(2 * difference / (p0 + root))
