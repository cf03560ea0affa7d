"""The figures of the comparison: all controllers, the horizon sweep, the step times, and single runs."""

from __future__ import annotations

import math
from functools import partial
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from pandas import DataFrame

from diffdrive_mpc.bench.chart_drawing import draw_chart
from diffdrive_mpc.bench.comparison.page import charts, error_chart, step_time_chart
from diffdrive_mpc.bench.comparison.results import ComparisonResults, best_of, predictive
from diffdrive_mpc.bench.experiment import COMPARED, by, mean
from diffdrive_mpc.bench.figure_style import (
    ERROR_MAP,
    REFERENCE_COLOUR,
    boxed_legend,
    colour,
    free_name,
    line_style,
    new_figure,
)
from diffdrive_mpc.bench.study import Charts, Draw
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.sim import Run
from diffdrive_mpc.sim.metrics.tracking_errors import metric_settings
from diffdrive_mpc.sim.plants.plug_ins import columns_of

_VISIBLE = 0.12
"""Largest error of a driven path in a figure, in units of the path's extent: so far it is magnified."""
_MAGNIFICATIONS = (1, 2, 5, 10, 20, 50, 100, 200, 500)
_DRAWN_TOGETHER = 3
"""Controllers whose driven paths are drawn over each other; of more only the best one is drawn."""
_PATHS_IN_A_ROW = 5


def drawings(results: ComparisonResults) -> dict[str, Draw | Charts]:
    """Every figure by file name, the overview first. Only runs of the first seed are drawn one by one."""
    made = charts(results)
    first = [name for name in ("speed.png", "dead-time.png") if name in made]
    figures: dict[str, Draw | Charts] = {"overview.png": partial(draw_overview, results.main)}
    figures |= {name: made[name] for name in [*first, *(name for name in made if name not in first)]}
    for name, rows in predictive(by(results.main, COMPARED)).items():
        seed = results.settings.values("seeds")[0]
        for case, run in zip(rows["case"], rows["run"], strict=True):
            if case.seed == seed:
                title = f"{name}, {case.labels['trajectory']}"
                figures[free_name(title, figures)] = partial(draw_case, run, f"{title}, seed {seed}")
    return figures


def draw_overview(main: DataFrame, path: Path) -> None:
    """Draw the driven paths, of the best predictive controller or of the few there are, and compare all controllers."""
    compared = by(main, COMPARED)
    best = best_of(predictive(compared))
    drawn = list(compared) if len(compared) <= _DRAWN_TOGETHER else [best]
    trajectories = list(by(compared[best], "trajectory"))
    rows = math.ceil(len(trajectories) / _PATHS_IN_A_ROW)
    with new_figure(path, 10.0, 3.2 + 2.8 * rows) as figure:
        halves = figure.add_gridspec(2, 1, height_ratios=(2.8 * rows, 3.2))
        upper, lower = figure.add_subfigure(halves[0]), figure.add_subfigure(halves[1])
        upper.suptitle(f"Driven by {', '.join(drawn)}, first seed")
        grid = upper.subplots(rows, min(len(trajectories), _PATHS_IN_A_ROW), squeeze=False).ravel()
        for axes, trajectory in zip(grid, trajectories, strict=False):
            runs = {name: by(compared[name], "trajectory")[trajectory] for name in drawn}
            factor = _paths(axes, {name: cells["run"].iloc[0] for name, cells in runs.items()})
            error = f"{best}: RMSE {1e3 * mean(runs[best], 'position_rmse_m'):.1f} mm"
            axes.set_title(f"{trajectory}\n{error}" + (f"\nerrors drawn × {factor:g}" if factor > 1 else ""))
        for axes in grid[len(trajectories) :]:
            axes.set_visible(False)
        grid[0].legend(loc="best")
        for axes, chart in zip(lower.subplots(1, 2), (error_chart(main), step_time_chart(main)), strict=True):
            draw_chart(axes, chart)
            axes.set_title(chart.title)
            axes.legend()


def _paths(axes: Axes, runs: dict[str, Run]) -> float:
    """Draw the reference and the driven paths by name of the controller.

    All errors are magnified by the factor that makes the largest of them visible. Gives the factor.
    """
    factor = min(magnified(run)[1] for run in runs.values())
    reference = next(iter(runs.values())).reference_pose[:, :2]
    axes.plot(*reference.T, color=REFERENCE_COLOUR, linewidth=3.0, label="reference")
    for place, (name, run) in enumerate(runs.items()):
        driven = run.reference_pose[:, :2] + factor * (run.true_pose[:, :2] - run.reference_pose[:, :2])
        axes.plot(*driven.T, color=colour(place), linestyle=line_style(place), linewidth=1.3, label=name)
    axes.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    return factor


def magnified(run: Run) -> tuple[FloatArray, float]:
    """(n, 2) the driven path with its position error magnified until it is seen [m], and the factor: 1, 2, 5, ..."""
    reference = run.reference_pose[:, :2]
    error = run.true_pose[:, :2] - reference
    largest = float(np.linalg.norm(error[run.counted], axis=1).max())
    wanted = _VISIBLE * float(np.ptp(reference, axis=0).max()) / max(largest, 1e-9)
    factor = max([1.0, *(steps for steps in _MAGNIFICATIONS if steps <= wanted)])
    return np.asarray(reference + factor * error), factor


def draw_case(run: Run, title: str, path: Path) -> None:
    """Draw `run` into the PNG file `path`."""
    with new_figure(path, 10.0, 6.4) as figure:
        grid = figure.add_gridspec(4, 2, width_ratios=(1.25, 1.0))
        left = figure.add_subplot(grid[:, 0])
        right = [figure.add_subplot(grid[i, 1]) for i in range(4)]
        figure.suptitle(title)
        draw_path(figure, left, run)
        _velocity(right[0], run, 0, "v [m/s]")
        _velocity(right[1], run, 1, "omega [rad/s]")
        _heading_error(right[2], run)
        _position_errors(right[3], run)
        for axes in right[:-1]:
            axes.sharex(right[-1])
            axes.tick_params(labelbottom=False)
        right[-1].set_xlabel("time [s]")
        figure.align_ylabels(right)


def draw_path(figure: Figure, axes: Axes, run: Run) -> None:
    """Reference and driven path; the colour is the position error, the X its largest value."""
    position, error = run.true_pose[:, :2], 1e3 * run.errors.position
    axes.plot(*run.reference_pose[:, :2].T, color="black", linestyle="--", linewidth=0.7, label="reference", zorder=3)
    segments = np.stack([position[:-1], position[1:]], axis=1)
    driven = LineCollection(list(segments), cmap=ERROR_MAP, linewidths=3.4)
    driven.set_array(0.5 * (error[:-1] + error[1:]))
    axes.add_collection(driven)
    beside, factor = magnified(run)
    if factor > 1:
        axes.plot(*beside.T, color="black", linewidth=0.9, label=f"driven, error × {factor:g}", zorder=2)
    worst = int(np.argmax(np.where(run.counted, error, -np.inf)))
    label = f"largest error, {error[worst]:.1f} mm"
    axes.plot(*position[worst], "X", color="#D55E00", markersize=10, markeredgecolor="white", label=label, zorder=5)
    axes.plot(*position[0], "o", color="black", markersize=5, label="start", zorder=4)
    for part in columns_of(run):
        part.draw(axes, run)
    axes.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    axes.margins(0.08)
    axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2 if factor > 1 else 3)
    figure.colorbar(driven, ax=axes, label="driven path: position error [mm]", shrink=0.7, pad=0.02)


def _velocity(axes: Axes, run: Run, channel: int, label: str) -> None:
    true = run.true_twist[:, (0, 2)[channel]]
    axes.plot(run.time, run.reference_twist[:, channel], color=REFERENCE_COLOUR, linestyle="--", label="reference")
    axes.step(run.time, run.command[:, channel], where="post", color=colour(1), linewidth=0.9, label="command")
    axes.plot(run.time, true, color=colour(0), label="true")
    axes.set_ylabel(label)
    if channel == 0:
        axes.legend(ncols=3, loc="lower center", bbox_to_anchor=(0.5, 1.0))


def _heading_error(axes: Axes, run: Run) -> None:
    axes.plot(run.time, run.errors.heading, color=colour(0), label="heading")
    axes.plot(run.time, run.errors.course, color=colour(1), linewidth=0.9, label="course")
    axes.set_ylabel("angle error [rad]")
    boxed_legend(axes)


def _position_errors(axes: Axes, run: Run) -> None:
    axes.plot(run.time, 1e3 * run.errors.position, color=colour(0), label="position")
    axes.plot(run.time, 1e3 * run.errors.lateral, color=colour(1), linewidth=0.9, label="lateral")
    band = 1e3 * metric_settings().band
    if np.nanmax(np.abs(1e3 * run.errors.position)) > 0.5 * band:
        axes.axhspan(-band, band, color=REFERENCE_COLOUR, alpha=0.12, linewidth=0)
    axes.set_ylabel("error [mm]")
    boxed_legend(axes)
