"""The printed tests of a virtual track against the printed line (Botta et al., Appl. Sci. 2021, 11(4), 1594)."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from scipy import stats

from diffdrive_mpc.bench.table import Table, number
from diffdrive_mpc.models.interface import FloatArray
from studies.reproduce.published import PaperFinding, Published, PublishedTrack


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
    """The tests as printed and with tracks exchanged, (n, 2) each, and the lines: printed, and fitted to both.

    Attributes
    ----------
    by_radius, by_radius_exchanged
        Correlation of the tracks, printed and exchanged, with those that the printed radii imply: without side-slip the
        driven circle is larger than the kinematic one as the virtual track is larger than the true one.
    exchanges, fitting
        How many double exchanges of tracks there are, and how many give the printed p1 as well.
    """

    tests: FloatArray
    exchanged: FloatArray
    printed: TrackLine
    fitted: TrackLine
    fitted_exchanged: TrackLine
    by_radius: float
    by_radius_exchanged: float
    exchanges: int
    fitting: int


def check_virtual_track(published: PublishedTrack, certain: float) -> VirtualTrackResult:
    """Fit lines to the printed tests; two numbers agree within `certain` standard deviations."""
    tests, radii = np.array(published.tests), np.array(published.radii)
    exchanged = exchange(tests, [(one - 1, other - 1) for one, other in published.exchanged])
    printed = TrackLine(published.p1, published.p0)
    implied = published.p0 * radii[:, 1] / radii[:, 0]
    single = itertools.combinations(range(len(tests)), 2)
    double = [pairs for pairs in itertools.combinations(single, 2) if not set(pairs[0]) & set(pairs[1])]
    return VirtualTrackResult(
        tests,
        exchanged,
        printed,
        fit_line(tests),
        fit_line(exchanged),
        float(np.corrcoef(implied, tests[:, 1])[0, 1]),
        float(np.corrcoef(implied, exchanged[:, 1])[0, 1]),
        len(double),
        sum(agree(printed, fit_line(exchange(tests, pairs)), certain) for pairs in double),
    )


def exchange(tests: FloatArray, pairs: Iterable[tuple[int, int]]) -> FloatArray:
    """Tests (n, 2) with the tracks of pairs of them exchanged."""
    changed = tests.copy()
    for one, other in pairs:
        changed[[one, other], 1] = tests[[other, one], 1]
    return changed


def agree(printed: TrackLine, fitted: TrackLine, certain: float) -> bool:
    """Whether the slopes are within `certain` standard deviations of each other."""
    return abs(fitted.p1 - printed.p1) < certain * fitted.p1_deviation


def fit_line(tests: FloatArray) -> TrackLine:
    """Least squares over tests (n, 2) of yaw rate [rad/s] and track [m]."""
    line = stats.linregress(np.abs(tests[:, 0]), tests[:, 1])
    return TrackLine(
        float(line.slope),
        float(line.intercept),
        float(line.stderr),
        float(line.intercept_stderr),
        float(line.rvalue),
    )


def virtual_track_findings(result: VirtualTrackResult, published: Published) -> list[PaperFinding]:
    """Whether the printed tests can be those behind the printed line."""
    certain, printed = published.rules.certain, result.printed
    within = f"within {certain:g} standard deviations"
    source, paper = "P3, section 3 and Table 1", f"{printed.p1:.3f} m s"
    gives = agree(printed, result.fitted_exchanged, certain)
    # It is one explanation among many unless few others would do, and the other columns side with it.
    explains = (
        result.by_radius_exchanged > result.by_radius and result.fitting <= published.rules.chance * result.exchanges
    )
    return [
        PaperFinding(
            f"the printed tests give the printed p1 {within}",
            source,
            paper,
            f"{_slope(result.fitted)} (no drive: the paper's rows)",
            (agree(printed, result.fitted, certain),),
        ),
        PaperFinding(
            f"tracks exchanged by mistake (tests 1, 2 with 7, 8; ours) explain the printed p1 {within}",
            source,
            paper,
            f"{_slope(result.fitted_exchanged)}; so do {result.fitting} of {result.exchanges} double exchanges; the "
            f"tracks that the radii imply correlate {result.by_radius:+.2f} with the printed ones, "
            f"{result.by_radius_exchanged:+.2f} with the exchanged",
            () if gives and not explains else (gives,),
        ),
    ]


def _slope(line: TrackLine) -> str:
    return f"{line.p1:.3f} ± {line.p1_deviation:.3f} m s"


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
