"""Figures of the comparison: overview, sweeps, step times and single runs."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
from matplotlib.axes import Axes
from pandas import DataFrame

from diffdrive_mpc.bench.chart_drawing import draw_charts, draw_run
from diffdrive_mpc.bench.comparison.page import charts, error_chart, step_time_chart
from diffdrive_mpc.bench.comparison.results import ComparisonResults, best_of, mpc_groups
from diffdrive_mpc.bench.experiment import COMPARED, by, mean
from diffdrive_mpc.bench.figure_style import free_name
from diffdrive_mpc.bench.html_report.page import Axis, Chart, RunViews, Series
from diffdrive_mpc.bench.html_report.run_series import rounded_list, run_series
from diffdrive_mpc.bench.study import Charts, Draw
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.sim import Run
from diffdrive_mpc.sim.plants.plug_ins import columns_of

_VISIBLE = 0.12
"""Maximum error of a magnified path in a figure, relative to the extent of the path [-]."""
_MAGNIFICATIONS = (1, 2, 5, 10, 20, 50, 100, 200, 500)
_CHARTS_IN_A_ROW = 3
_TICKS_OF_A_RUN = 2000


def report_figures(results: ComparisonResults) -> dict[str, Draw | Charts]:
    """Return the figures by file name, starting with the overview; each run of the first seed has a figure."""
    swept = charts(results)
    first = [name for name in ("speed.png", "dead-time.png") if name in swept]
    overview = [*_error_charts(results.main), error_chart(results.main), step_time_chart(results.main)]
    figures: dict[str, Draw | Charts] = {"overview.png": partial(draw_charts, overview, columns=_CHARTS_IN_A_ROW)}
    figures |= {name: swept[name] for name in [*first, *(name for name in swept if name not in first)]}
    for name, rows in mpc_groups(by(results.main, COMPARED)).items():
        seed = results.settings.values("seeds")[0]
        for case, run in zip(rows["case"], rows["run"], strict=True):
            if case.seed == seed:
                title = f"{name}, {case.labels['trajectory']}"
                figures[free_name(title, figures)] = partial(draw_case, run, f"{title}, seed {seed}")
    return figures


def _error_charts(main: DataFrame) -> list[Chart]:
    """Return a chart of position error over time for each trajectory, with the best MPC and peer."""
    compared = by(main, COMPARED)
    styles, groups = list(compared), mpc_groups(compared)
    peers = {name: rows for name, rows in compared.items() if name not in groups}
    best = [best_of(part) for part in (groups, peers) if part]
    rows = {name: by(compared[name], "trajectory") for name in best}
    runs = {path: {name: rows[name][path]["run"].iloc[0] for name in best} for path in rows[best[0]]}
    errors = {path: {name: 1e3 * run.errors.position for name, run in part.items()} for path, part in runs.items()}
    error_charts = []
    for path, part in errors.items():
        series = [
            Series(name, rounded_list(runs[path][name].time, 3), rounded_list(error, 2), styles.index(name), "line")
            for name, error in part.items()
        ]
        means = [f"{name} {1e3 * mean(rows[name][path], 'position_rmse_m'):.1f}" for name in best]
        stopped = [f"{name} did not complete" for name, run in runs[path].items() if run.ended]
        title = f"{path}: {', '.join([*means, *stopped])}"
        top = 1.05 * max(float(np.max(error)) for error in part.values())
        axes = Axis("time [s]"), Axis("position error [mm]", range=(0.0, top))
        error_charts.append(Chart(title, *axes, series))
    return error_charts


def magnification(run: Run) -> float:
    """Return the factor 1, 2, 5, ... with which the maximum position error is visible."""
    error = np.linalg.norm((run.true_pose - run.reference_pose)[run.counted, :2], axis=1).max()
    limit = _VISIBLE * float(np.ptp(run.reference_pose[:, :2], axis=0).max()) / max(float(error), 1e-9)
    return max([1.0, *(factor for factor in _MAGNIFICATIONS if factor <= limit)])


def magnify(run: Run, factor: float) -> FloatArray:
    """Return the driven poses (n, 3) with their deviation from the reference multiplied by `factor`."""
    return np.asarray(run.reference_pose + factor * (run.true_pose - run.reference_pose))


def draw_case(run: Run, title: str, path: Path) -> None:
    """Draw `run` into the PNG file `path`; a position error that is too small to see is magnified."""
    views, factor = run_series(run, "run", points=_TICKS_OF_A_RUN), magnification(run)
    more = [_in_plane(f"driven, error x {factor:g}", magnify(run, factor), 6)] if factor > 1 else []

    def draw_parts(axes: Axes) -> None:
        for part in columns_of(run):
            part.draw(axes, run)

    draw_run(RunViews([replace(views, plane=[*views.plane, *more])]), title, path, draw_parts)


def _in_plane(name: str, poses: FloatArray, style: int, kind: Literal["line", "reference"] = "line") -> Series:
    return Series(name, rounded_list(poses[:, 0], 4), rounded_list(poses[:, 1], 4), style, kind)
