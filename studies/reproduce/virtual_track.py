"""Virtual track of a robot (P3: Botta et al., Appl. Sci. 2021, 11(4), 1594).

The tests in the paper's table are compared with the line in the paper's text. The eight tests are also driven on the
simulated robot, to find its virtual track and the factors that affect it. The virtual track is the difference of the
rim speeds of both sides over the true yaw rate, in the steady part of a drive.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from diffdrive_mpc.bench.table import Table, number
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.robot import load_robot
from diffdrive_mpc.sim import make_plant
from studies.open_loop import drive_open_loop
from studies.reproduce.published import PaperFinding, Published, PublishedTrack, TrackStudy


@dataclass(frozen=True)
class TrackLine:
    """Line `track = p1 |yaw rate| + p0` with standard deviations and correlation coefficient.

    Attributes
    ----------
    p1
        Slope [m s].
    p0
        Intercept [m].
    p1_deviation, p0_deviation
        Standard deviations of slope [m s] and intercept [m]; NaN if unknown.
    correlation
        Correlation of track and yaw rate [-]; NaN if unknown.
    """

    p1: float
    p0: float
    p1_deviation: float = float("nan")
    p0_deviation: float = float("nan")
    correlation: float = float("nan")

    def misfit(self, tests: FloatArray) -> float:
        """Compute the RMS difference [m] between the tracks of tests (n, 2) and the line."""
        return float(np.sqrt(np.mean((tests[:, 1] - self.p1 * np.abs(tests[:, 0]) - self.p0) ** 2)))


@dataclass(frozen=True)
class VirtualTrackResult:
    """Printed tests (n, 2), tests with exchanged tracks (n, 2), the printed line, and lines fitted to both.

    Attributes
    ----------
    by_radius, by_radius_exchanged
        Correlation of the printed and of the exchanged tracks with the tracks that follow from the printed radii:
        without side-slip, the ratio of driven and kinematic radius equals the ratio of virtual and true track.
    exchanges, fitting
        Number of exchanges of the tracks of two pairs of tests, and number of such exchanges whose fitted line also has
        the printed p1.
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


def check_virtual_track(published: PublishedTrack, threshold: float) -> VirtualTrackResult:
    """Fit lines to the printed tests; `threshold` is the number of standard deviations within which slopes agree."""
    tests, radii = np.array(published.tests), np.array(published.radii)
    exchanged = exchange(tests, [(first - 1, second - 1) for first, second in published.exchanged])
    printed = TrackLine(published.p1, published.p0)
    implied_tracks = published.p0 * radii[:, 1] / radii[:, 0]
    exchanges = itertools.combinations(range(len(tests)), 2)
    doubles = [pairs for pairs in itertools.combinations(exchanges, 2) if not set(pairs[0]) & set(pairs[1])]
    return VirtualTrackResult(
        tests,
        exchanged,
        printed,
        fit_line(tests),
        fit_line(exchanged),
        float(np.corrcoef(implied_tracks, tests[:, 1])[0, 1]),
        float(np.corrcoef(implied_tracks, exchanged[:, 1])[0, 1]),
        len(doubles),
        sum(agree(printed, fit_line(exchange(tests, pairs)), threshold) for pairs in doubles),
    )


def exchange(tests: FloatArray, pairs: Iterable[tuple[int, int]]) -> FloatArray:
    """Return a copy of tests (n, 2) in which the tests of each pair have exchanged their tracks."""
    exchanged = tests.copy()
    for first, second in pairs:
        exchanged[[first, second], 1] = tests[[second, first], 1]
    return exchanged


def agree(printed: TrackLine, fitted: TrackLine, threshold: float) -> bool:
    """Return True if the slopes are within `threshold` standard deviations of each other."""
    return abs(fitted.p1 - printed.p1) < threshold * fitted.p1_deviation


def fit_line(tests: FloatArray) -> TrackLine:
    """Fit a line to tests (n, 2) of yaw rate [rad/s] and track [m] by least squares."""
    line = stats.linregress(np.abs(tests[:, 0]), tests[:, 1])
    return TrackLine(
        float(line.slope),
        float(line.intercept),
        float(line.stderr),
        float(line.intercept_stderr),
        float(line.rvalue),
    )


def virtual_track_findings(result: VirtualTrackResult, published: Published) -> list[PaperFinding]:
    """Evaluate whether the printed line can result from the printed tests."""
    threshold, printed = published.rules.agreement_deviations, result.printed
    within = f"within {threshold:g} standard deviations"
    source, paper = "P3, section 3 and Table 1", f"{printed.p1:.3f} m s"
    slopes_agree = agree(printed, result.fitted_exchanged, threshold)
    # The exchange explains p1 only if few other exchanges have the same slope, and if the printed radii support it.
    is_explanation = (
        result.by_radius_exchanged > result.by_radius
        and result.fitting <= published.rules.max_chance * result.exchanges
    )
    return [
        PaperFinding(
            f"the printed tests result in the printed p1 {within}",
            source,
            paper,
            f"{_slope(result.fitted)} (from the paper's rows, not from drives)",
            (agree(printed, result.fitted, threshold),),
        ),
        PaperFinding(
            f"tracks exchanged by mistake (tests 1, 2 with 7, 8) explain the printed p1 {within}",
            source,
            paper,
            f"{_slope(result.fitted_exchanged)}; {result.fitting} of {result.exchanges} double exchanges fit; the "
            f"correlation with the tracks that follow from the radii is {result.by_radius:+.2f} for the printed and "
            f"{result.by_radius_exchanged:+.2f} for the exchanged tracks",
            () if slopes_agree and not is_explanation else (slopes_agree,),
        ),
    ]


def _slope(line: TrackLine) -> str:
    return f"{line.p1:.3f} ± {line.p1_deviation:.3f} m s"


def virtual_track_table(result: VirtualTrackResult) -> Table:
    """Tabulate p1 and p0 of the three lines."""
    rows = (
        ("printed coefficients", *_cells(result.printed, result)),
        ("least squares over the printed tests", *_cells(result.fitted, result)),
        ("least squares, tracks of tests 1, 2 and 7, 8 exchanged", *_cells(result.fitted_exchanged, result)),
    )
    columns = ("line", "p1 [m s]", "p0 [m]", "correlation [-]", "misfit, as printed [mm]", "misfit, exchanged [mm]")
    note = (
        "track = p1 |yaw rate| + p0 (P3, section 3 and Table 1), with standard deviations. Misfit: RMS difference "
        "between the tests' tracks and the line. All data are from the paper."
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


_SEED = 400
"""Seed of the first drive on a surface."""
_SERIES = ("turning on the spot, over yaw rate", "at constant v, over yaw rate", "at constant yaw rate, over v")


@dataclass(frozen=True)
class DrivenTrack:
    """Virtual tracks of the simulated robot on one surface.

    Attributes
    ----------
    surface
        Name of the surface.
    tests, series
        Results (n, 4) of the paper's tests, and of drives with constant v or constant yaw rate: v [m/s], yaw rate
        [rad/s], virtual track [m], and ratio of wheel speed and true speed [-].
    line
        Line through the tests.
    """

    surface: str
    tests: FloatArray
    series: dict[str, FloatArray]
    line: TrackLine

    @property
    def slopes(self) -> dict[str, TrackLine]:
        """Lines through each series of drives, as functions of the varied quantity."""
        return {name: fit_line(rows[:, [0 if name == _SERIES[2] else 1, 2]]) for name, rows in self.series.items()}

    @property
    def by_acceleration(self) -> TrackLine:
        """Line through all drives: virtual track over the squared product of v and yaw rate [m^2/s^4]."""
        rows = np.vstack([self.tests, *self.series.values()])
        return fit_line(np.column_stack([(rows[:, 0] * rows[:, 1]) ** 2, rows[:, 2]]))


def drive_tests(study: TrackStudy, surface: str) -> DrivenTrack:
    """Run the paper's tests, and drives with constant v or constant yaw rate, on one surface."""
    v, yaw = study.v, study.yaw_rate
    series = dict(
        zip(
            _SERIES,
            (
                [(0.0, yaw_rate) for yaw_rate in study.yaw_rates],
                [(v, yaw_rate) for yaw_rate in study.yaw_rates],
                [(speed, yaw) for speed in study.speeds],
            ),
            strict=True,
        )
    )
    tests = _drive_twists(study, surface, study.tests)
    return DrivenTrack(
        surface,
        tests,
        {name: _drive_twists(study, surface, twists) for name, twists in series.items()},
        fit_line(tests[:, 1:3]),
    )


def _drive_twists(study: TrackStudy, surface: str, twists: Sequence[tuple[float, float]]) -> FloatArray:
    """Drive constant commands v [m/s] and omega [rad/s]; return results (n, 4) as in `DrivenTrack.tests`."""
    robot, rows = load_robot(), []
    steps, settled_steps = (round(time / robot.sample_time) for time in (study.duration, study.settling))
    ramp = np.minimum(1.0, np.arange(steps) / (0.25 * settled_steps))[:, None]
    for index, twist in enumerate(twists):
        drive = drive_open_loop(make_plant("mujoco", surface=surface, seed=_SEED + index), ramp * twist)
        v, _, yaw = drive.true_twist[settled_steps:].mean(axis=0)
        wheels = drive.wheel_twist[settled_steps:].mean(axis=0)
        rows.append((v, yaw, robot.track * wheels[1] / yaw, wheels[0] / v if twist[0] else np.nan))
    return np.array(rows)


def driven_track_tables(results: Sequence[DrivenTrack], published: Published) -> list[Table]:
    """Tabulate the measured and the published tests, and the dependence of the virtual track on v and yaw rate."""
    paper, commands = published.virtual_track, results[0].tests
    rows = [
        (
            str(k + 1),
            f"{yaw:.3f}",
            f"{track:.3f}",
            *(f"{result.tests[k, c]:.3f}" for result in results for c in (0, 1, 2)),
        )
        for k, (yaw, track) in enumerate(paper.tests[: len(commands)])
    ]
    slope_rows = [("P3, Epi.q", f"{paper.p1:.3f}", f"{paper.p0:.3f}", "-", *["-"] * (len(_SERIES) + 1))]
    for result in results:
        slopes = [_format_estimate(1e3 * line.p1, 1e3 * line.p1_deviation, 1) for line in result.slopes.values()]
        slope_rows.append(
            (
                result.surface,
                _format_estimate(result.line.p1, result.line.p1_deviation, 4),
                _format_estimate(result.line.p0, result.line.p0_deviation, 4),
                f"{result.line.correlation:.2f}",
                *slopes,
                f"{_format_estimate(1e3 * result.by_acceleration.p1, 1e3 * result.by_acceleration.p1_deviation, 0)} "
                f"({result.by_acceleration.correlation:.2f})",
            )
        )
    columns = ["test", "P3: yaw rate [rad/s]", "P3: track [m]"]
    for result in results:
        columns += [f"{result.surface}: v [m/s]", "yaw rate [rad/s]", "track [m]"]
    return [
        Table(
            "Driven virtual track",
            tuple(columns),
            tuple(rows),
            note="Steady part of open-loop drives of the simulated robot (true track 0.330 m) with the paper's "
            "commands; v and yaw rate are true values.",
        ),
        Table(
            "Dependence of the virtual track",
            (
                "surface",
                "p1 [m s]",
                "p0 [m]",
                "correlation [-]",
                "on the spot, over yaw rate [mm s]",
                "constant v, over yaw rate [mm s]",
                "constant yaw rate, over v [mm s/m]",
                "over (v yaw rate)^2 [mm s^4/m^2] (correlation)",
            ),
            tuple(slope_rows),
            note="Line through the eight tests, then slopes of drives with one constant quantity, with standard "
            "deviations. The last column is the slope over all drives.",
        ),
    ]


def _format_estimate(value: float, deviation: float, digits: int) -> str:
    return f"{value:.{digits}f} ± {deviation:.{digits}f}"


def driven_track_findings(results: Sequence[DrivenTrack], published: Published) -> list[PaperFinding]:
    """Evaluate the sign of P3's slope on the simulated robot, and its causes; one verdict per surface."""
    threshold, paper = published.rules.agreement_deviations, published.virtual_track
    surfaces = ", ".join(result.surface for result in results)
    spot, _, speed = _SERIES
    return [
        PaperFinding(
            f"the virtual track grows with the yaw rate, by {threshold:g} standard deviations or more ({surfaces})",
            "P3, section 3",
            f"{paper.p1:.3f} m s",
            "; ".join(f"{_format_estimate(result.line.p1, result.line.p1_deviation, 4)} m s" for result in results),
            tuple(result.line.p1 > threshold * result.line.p1_deviation for result in results),
        ),
        PaperFinding(
            f"at constant yaw rate the virtual track does not depend on v, within {threshold:g} standard deviations "
            f"({surfaces})",
            "P3's law",
            "the law does not contain v",
            "; ".join(
                f"{_format_estimate(1e3 * (s := result.slopes[speed]).p1, 1e3 * s.p1_deviation, 1)} mm s/m"
                for result in results
            ),
            tuple(abs(result.slopes[speed].p1) < threshold * result.slopes[speed].p1_deviation for result in results),
        ),
        PaperFinding(
            f"on the spot, the virtual track does not decrease with the yaw rate by {threshold:g} standard deviations "
            f"or more ({surfaces})",
            "ours",
            "-",
            "; ".join(
                f"{_format_estimate(1e3 * (s := result.slopes[spot]).p1, 1e3 * s.p1_deviation, 1)} mm s"
                for result in results
            ),
            tuple(result.slopes[spot].p1 > -threshold * result.slopes[spot].p1_deviation for result in results),
        ),
    ]
