"""The printed tests of a virtual track against the printed line (Botta et al., Appl. Sci. 2021, 11(4), 1594)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy import stats

from diffdrive_mpc.bench.studies.reproduce.published import Finding, Published, PublishedTrack
from diffdrive_mpc.bench.table import Table, number
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


def virtual_track_findings(result: VirtualTrackResult, published: Published) -> list[Finding]:
    """Whether the printed tests can be those behind the printed line."""
    certain = published.rules.certain
    within = f"within {certain:g} standard deviations"
    return [
        _agrees(f"the printed tests give the printed p1 {within}", result.printed, result.fitted, certain),
        _agrees(
            f"with tracks exchanged (tests 1, 2 with 7, 8; ours) they give the printed p1 {within}",
            result.printed,
            result.fitted_exchanged,
            certain,
        ),
    ]


def _agrees(claim: str, printed: TrackLine, fitted: TrackLine, certain: float) -> Finding:
    return Finding(
        claim,
        "P3, section 3 and Table 1",
        f"{printed.p1:.3f} m s",
        f"{fitted.p1:.3f} ± {fitted.p1_deviation:.3f} m s (no drive: the paper's rows)",
        (abs(fitted.p1 - printed.p1) < certain * fitted.p1_deviation,),
    )


def virtual_track_table(result: VirtualTrackResult) -> Table:
    """p1 and p0 of the three lines."""
    rows = (
        ("printed coefficients", *_cells(result.printed, result)),
        ("least squares over the printed tests", *_cells(result.fitted, result)),
        ("the same, tracks of tests 1, 2 and 7, 8 exchanged", *_cells(result.fitted_exchanged, result)),
    )
    columns = ("line", "p1 [m s]", "p0 [m]", "correlation [-]", "misfit, as printed [mm]", "misfit, exchanged [mm]")
    note = (
        "track = p1 |yaw rate| + p0 (P3, section 3 and Table 1), with standard deviations; RMS distance of the tests' "
        "tracks from each line. No drive of ours: this is about the paper's own rows."
    )
    return Table("Virtual track", columns, rows, note=note)


def _cells(line: TrackLine, result: VirtualTrackResult) -> tuple[str, ...]:
    return (
        _with_deviation(line.p1, line.p1_deviation),
        _with_deviation(line.p0, line.p0_deviation),
        number(line.correlation, 2),
        number(1e3 * line.misfit(result.tests), 1),
        number(1e3 * line.misfit(result.exchanged), 1),
    )


def _with_deviation(value: float, deviation: float) -> str:
    return f"{value:.3f}" + (f" ± {deviation:.3f}" if math.isfinite(deviation) else "")
