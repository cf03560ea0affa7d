"""Page of `diffdrive-mpc simulate`: one run with linked views."""

from __future__ import annotations

from collections.abc import Sequence

from diffdrive_mpc.bench.case import AS_FILED, DIMENSIONS, NO_SCENARIO, Case
from diffdrive_mpc.bench.html_report.origin import configuration, mpc_config, origin
from diffdrive_mpc.bench.html_report.page import KeyFigure, Page, PageContents, RunViews
from diffdrive_mpc.bench.html_report.run_series import HOW_TO_READ, PEAKS, run_series
from diffdrive_mpc.bench.html_report.run_warnings import run_warnings
from diffdrive_mpc.bench.machine import describe_run
from diffdrive_mpc.bench.run_row import STATISTICS, RunOutcome, driver_name
from diffdrive_mpc.bench.table import Table, number
from diffdrive_mpc.sim import Run
from diffdrive_mpc.sim.metrics.tracking_errors import metric_settings
from diffdrive_mpc.sim.plants.plug_ins import columns_of

POINTS = 2000
"""Maximum number of ticks on the page."""


def key_figures(run: Run) -> list[KeyFigure]:
    """List the key figures of a run."""
    metrics, band = run.metrics, f"±{1e3 * metric_settings().band:g} mm to either side of the path"
    late = f"of {1e3 * run.sample_time:.1f} ms; {metrics.deadline_misses or 'none'} late"
    step = f"{number(1e3 * metrics.step_time_p99_s, 2)} ms"
    return [
        KeyFigure("completed", "yes" if metrics.completed else "no", run.ended, "good" if metrics.completed else "bad"),
        KeyFigure("position error, RMSE", _mm(metrics.position_rmse_m), f"largest {_mm(metrics.position_max_m)}"),
        KeyFigure("lateral error, RMSE", _mm(metrics.lateral_rmse_m), f"largest {_mm(metrics.lateral_max_m)}"),
        KeyFigure("inside the band", f"{number(metrics.in_band_percent, 1)} %", band),
        KeyFigure("step time, p99", step, late),
        KeyFigure(
            "fallbacks", str(metrics.fallbacks), "ticks without a fresh plan", "bad" if metrics.fallbacks else "good"
        ),
    ]


def sentences(case: Case, run: Run) -> list[str]:
    """Describe a run and its completion."""
    metrics, labels, omitted = run.metrics, case.labels, (NO_SCENARIO, AS_FILED)
    conditions = [
        f"{dimension.name} {labels[dimension.name]}"
        for dimension in DIMENSIONS
        if dimension.place and labels[dimension.name] not in omitted
    ]
    ending = "reached the end" if metrics.completed else "did not reach the end"
    return [
        f"{driver_name(case)} drove “{run.reference.name}” in {run.reference.duration:.1f} s ({', '.join(conditions)}, "
        f"seed {case.seed}). It {ending}: the lateral error was {_mm(metrics.lateral_rmse_m)} RMSE and "
        f"{_mm(metrics.lateral_max_m)} at most.",
        *filter(None, (part.summary(run) for part in columns_of(run))),
    ]


def single_page(outcome: RunOutcome, tables: Sequence[Table], seconds: float) -> Page:
    """Build the page of a run with `tables`; `seconds` is the wall-clock time of the run."""
    case, run = outcome.case, outcome.run
    config = mpc_config(case)
    series = run_series(run, driver_name(case), points=POINTS, config=config)
    shown = PageContents(
        summary=sentences(case, run),
        notes=[
            f"Errors: {STATISTICS}. The controller does not know the true pose. Lateral: distance from the path.",
            *filter(None, [getattr(run.reference, "remark", "")]),
        ],
        key_figures=key_figures(run),
        views=[RunViews([series], f"{HOW_TO_READ}. {PEAKS}." if len(run.time) > POINTS else f"{HOW_TO_READ}.")],
        warnings=run_warnings(run, config),
        configurations=configuration(case),
    )
    title = f"{driver_name(case)} along {case.labels['trajectory']}"
    return Page(
        "diffdrive-mpc simulate", title, shown, tables, origin(describe_run(seconds), [("seed", str(case.seed))])
    )


def _mm(length: float) -> str:
    return f"{number(1e3 * length, 1)} mm"
