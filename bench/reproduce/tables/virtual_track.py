"""The printed line of a virtual track, and what the printed tests give."""

from __future__ import annotations

import math

from diffdrive_mpc.bench.reproduce.experiments.virtual_track import TrackLine, VirtualTrackResult
from diffdrive_mpc.bench.table import Table, number


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
