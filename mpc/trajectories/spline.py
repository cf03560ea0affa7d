"""Cubic spline trajectories, for paths that do not consist of arcs."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.mpc.trajectories.native import TableTrajectory

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(3)


@dataclass(frozen=True, eq=False, repr=False)
class SplineTrajectory(TableTrajectory):
    """Trajectory of cubic pieces of x, y, theta and arc length; the twist is the derivative in the body frame.

    Attributes
    ----------
    breaks
        (m + 1,) times of the ends of the pieces [s], from 0 to the duration.
    table
        (16, m) coefficients of x, y, theta and arc length for each power of the time since the start of the piece,
        highest power first.
    drawn
        (m + 1,) distances at the breaks from the drawn path, the path in the file [m]; None if both paths are equal.
    """

    drawn: FloatArray | None = None

    @classmethod
    def through(
        cls, name: str, times: FloatArray, poses: FloatArray, rates: FloatArray, drawn: FloatArray | None = None
    ) -> SplineTrajectory:
        """Interpolate poses (m + 1, 3) and their time derivatives (m + 1, 3) at `times` (m + 1,), which start at 0.

        `drawn` (m + 1,) are the distances from the drawn path [m]; None if both paths are equal.
        """
        motion, step = _hermite(times, poses, rates), np.diff(times)
        inside = times[:-1, None] + step[:, None] * (_NODES + 1) / 2
        elapsed = (inside - times[:-1, None])[..., None]
        squared = elapsed * elapsed
        cubic, square, linear, constant = motion[:, :, None]
        value = constant + linear * elapsed + square * squared + cubic * (squared * elapsed)
        slope = linear + square * elapsed * 2 + cubic * squared * 3
        advance = _speed(value, slope) @ _WEIGHTS * step / 2
        # A cubic piece is monotone if its end slopes are at most three times its mean slope (Fritsch, Carlson, SIAM J.
        # Numer. Anal. 17(2), 1980). This changes the slopes only where the speed passes through zero.
        mean = np.pad(advance / step, 1, mode="edge")
        slope = np.minimum(_speed(poses, rates), 3 * np.minimum(mean[:-1], mean[1:]))
        arc_length = _hermite(times, np.concatenate([[0.0], np.cumsum(advance)])[:, None], slope[:, None])
        coefficients = np.concatenate([motion, arc_length], axis=-1)
        table = np.ascontiguousarray(coefficients.transpose(0, 2, 1).reshape(16, -1))
        return cls(name, float(times[-1]), times, table, drawn)

    def delayed(self, seconds: float) -> Self:
        """Return the trajectory with a preceding standstill of `seconds` [s], see `TableTrajectory.delayed`."""
        delayed = super().delayed(seconds)
        return delayed if self.drawn is None else replace(delayed, drawn=np.append(self.drawn[:1], self.drawn))

    def drawn_distance(self, times: ArrayLike) -> FloatArray:
        """Compute the distance (n,) [m] from the drawn path, see `Trajectory.drawn_distance`."""
        if self.drawn is None:
            return super().drawn_distance(times)
        return np.asarray(np.interp(np.asarray(times, dtype=float).reshape(-1), self.breaks, self.drawn))


def _hermite(times: FloatArray, values: FloatArray, slopes: FloatArray) -> FloatArray:
    """Compute the coefficients (4, m, n), as in `table`, of cubic pieces through values (m + 1, n) with given slopes.

    SciPy is not used, since its import takes longer than the import of the whole controller.
    """
    step = np.diff(times)[:, None]
    mean = np.diff(values, axis=0) / step
    bend = (slopes[:-1] + slopes[1:] - 2 * mean) / step
    return np.stack([bend / step, (mean - slopes[:-1]) / step - bend, slopes[:-1], values[:-1]])


def _speed(poses: FloatArray, rates: FloatArray) -> FloatArray:
    """Compute the absolute forward speed (...) [m/s] for poses and their time derivatives (..., 3)."""
    heading = poses[..., 2]
    return np.asarray(np.abs(rates[..., 0] * np.cos(heading) + rates[..., 1] * np.sin(heading)))
