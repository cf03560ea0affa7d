"""The printed tests of a virtual track against the printed line (Botta et al., Appl. Sci. 2021, 11(4), 1594)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import stats

from diffdrive_mpc.bench.reproduce.published import PublishedTrack
from diffdrive_mpc.models.interface import FloatArray


@dataclass(frozen=True)
class TrackLine:
    """track = p1 |yaw rate| + p0, with the standard deviations of both and the correlation coefficient.

    Attributes
    ----------
    p1
        [m s].
    p0
        [m].
    p1_deviation, p0_deviation
        Standard deviation of each; NaN where none is known.
    correlation
        Of track and yaw rate [-].
    """

    p1: float
    p0: float
    p1_deviation: float = float("nan")
    p0_deviation: float = float("nan")
    correlation: float = float("nan")

    def misfit(self, tests: FloatArray) -> float:
        """RMS distance [m] of the tracks of tests (n, 2) from the line."""
        return float(np.sqrt(np.mean((tests[:, 1] - self.p1 * np.abs(tests[:, 0]) - self.p0) ** 2)))


@dataclass(frozen=True)
class VirtualTrackResult:
    """The tests as printed and with tracks exchanged, (n, 2) each, and the lines: printed, and fitted to both."""

    tests: FloatArray
    exchanged: FloatArray
    printed: TrackLine
    fitted: TrackLine
    fitted_exchanged: TrackLine


def check_virtual_track(published: PublishedTrack) -> VirtualTrackResult:
    """Fit lines to the printed tests."""
    tests = np.array(published.tests)
    exchanged = tests.copy()
    for one, other in published.exchanged:
        exchanged[[one - 1, other - 1], 1] = tests[[other - 1, one - 1], 1]
    printed = TrackLine(published.p1, published.p0)
    return VirtualTrackResult(tests, exchanged, printed, fit_line(tests), fit_line(exchanged))


def fit_line(tests: FloatArray) -> TrackLine:
    """Least squares over tests (n, 2) of yaw rate [rad/s] and track [m]."""
    found = stats.linregress(np.abs(tests[:, 0]), tests[:, 1])
    return TrackLine(
        float(found.slope),
        float(found.intercept),
        float(found.stderr),
        float(found.intercept_stderr),
        float(found.rvalue),
    )
