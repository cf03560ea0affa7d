"""Torque of the sides over signed curvature as one smooth curve, the same for numbers and for CasADi.

A turn to the left takes the right side as the outer one, a turn to the right as the inner one; backward all torques
change their signs. So with the mean m and half the difference d of outer and inner side, both without the drag of
the drive train, the right side has sign(v) m(k) + d(k) and the left one sign(v) m(k) - d(k), m even and d odd in the
curvature k: P is even at straight on, and smooth. The drag turns with the wheel, so it changes its sign where the
inner wheels begin to turn backward.
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import PchipInterpolator, make_lsq_spline

from diffdrive_mpc.models.interface import FloatArray

_DEGREE = 3
_INTERVALS = 36
_DENSE = 60
# Curvature at which the scale goes from linear to logarithmic [1/m].
_BEND = 0.05


class TorqueSpline:
    """Cubic splines through a table over asinh of the curvature, held beyond its ends.

    Parameters
    ----------
    curvature
        (n,) ascending, positive [1/m].
    mean
        (n,) half the sum of outer and inner traction torque [N m].
    difference
        (n,) half their difference [N m].
    """

    def __init__(self, curvature: ArrayLike, mean: ArrayLike, difference: ArrayLike) -> None:
        scaled = np.arcsinh(np.asarray(curvature, dtype=float) / _BEND)
        self._most = float(scaled[-1])
        self._width = 2 * self._most / _INTERVALS
        self._knots = self._most * np.linspace(-1, 1, _INTERVALS + 1)
        outside = self._width * np.arange(1, _DEGREE + 1)
        knots = np.concatenate([-self._most - outside[::-1], self._knots, self._most + outside])
        dense = np.linspace(-self._most, self._most, _DENSE * _INTERVALS + 1)
        self._splines = []
        for values, odd in ((mean, False), (difference, True)):
            torques = np.asarray(values, dtype=float)
            # Straight on there is no difference, and the mean is that of the widest turn.
            table = PchipInterpolator(np.append(0.0, scaled), np.append(0.0 if odd else torques[0], torques))
            whole = table(np.abs(dense)) * (np.sign(dense) if odd else 1.0)
            self._splines.append(make_lsq_spline(dense, whole, knots, k=_DEGREE))

    def __call__(self, curvature: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mean and half difference [N m] at signed curvatures (n,) [1/m]."""
        scaled = np.clip(np.arcsinh(curvature / _BEND), -self._most, self._most)
        mean, difference = (np.asarray(spline(scaled)) for spline in self._splines)
        return mean, difference

    def symbolic(self, curvature: Any) -> tuple[Any, Any]:  # noqa: ANN401 - SX or MX
        """The same as CasADi expressions, with continuous second derivatives but at the two ends of the table."""
        scaled = ca.fmax(-self._most, ca.fmin(self._most, ca.asinh(curvature / _BEND)))
        # Uniform B-splines as cubes of what lies beyond each knot: no cases, so derivatives hold everywhere.
        binomial = np.array([1.0, -4.0, 6.0, -4.0, 1.0]) / 6.0
        weights = [np.convolve(spline.c, binomial) for spline in self._splines]
        mean: Any = 0.0
        difference: Any = 0.0
        for k, knot in enumerate(self._splines[0].t):
            if knot < self._most:
                beyond = ca.fmax(0.0, (scaled - knot) / self._width)
                cube = beyond * beyond * beyond
                mean, difference = mean + weights[0][k] * cube, difference + weights[1][k] * cube
        return mean, difference
