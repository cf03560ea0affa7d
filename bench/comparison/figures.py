"""The figures of the comparison: all controllers, the horizon sweep, the step times, and single runs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from diffdrive_mpc.bench.comparison.results import ComparisonResults, predictive
from diffdrive_mpc.bench.figure_style import (
    ERROR_MAP,
    MARKERS,
    REFERENCE_COLOUR,
    boxed_legend,
    colour,
    draw_tail,
    free_name,
    line_style,
    new_figure,
)
from diffdrive_mpc.bench.outcomes import (
    Outcome,
    Score,
    by,
    by_driver,
    by_horizon,
    by_model,
    group,
    mean,
    solve_times,
    step_times,
    time_percentile,
    who_drives,
)
from diffdrive_mpc.bench.study import Draw
from diffdrive_mpc.bench.world_drawing import draw_world
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.sim import Run
from diffdrive_mpc.sim.metrics.tracking_errors import metric_settings

_VISIBLE = 0.12
"""Largest error of a driven path in a figure, in units of the path's extent: so far it is magnified."""
_MAGNIFICATIONS = (1, 2, 5, 10, 20, 50, 100, 200, 500)


def drawings(results: ComparisonResults) -> dict[str, Draw]:
    """What draws each figure by file name, the overview first. Only runs of the first seed are drawn one by one."""
    figures: dict[str, Draw] = {"overview.png": partial(draw_overview, results.main)}
    if results.speed:
        figures["speed.png"] = partial(draw_speed, results.speed)
    if results.dead_time:
        figures["dead-time.png"] = partial(draw_dead_time, results.dead_time, results.main[0].run.sample_time)
    figures["step-time.png"] = partial(draw_step_times, results.main)
    if results.horizon:
        figures["horizon.png"] = partial(draw_horizons, results.horizon)
    for name, runs in predictive(by_driver(results.main)).items():
        for outcome in runs:
            if outcome.case.seed == results.settings.values("seeds")[0]:
                title = f"{name}, {outcome.case.labels['trajectory']}"
                figures[free_name(title, figures)] = partial(
                    draw_case, outcome.run, f"{title}, seed {outcome.case.seed}"
                )
    return figures


def draw_overview(outcomes: Sequence[Outcome], path: Path) -> None:
    """Draw the path of the predictive controller with the least position RMSE, and compare all controllers."""
    compared = by_driver(outcomes)
    ours = predictive(compared)
    best = min(ours, key=lambda name: np.nan_to_num(mean(ours[name], "position_rmse_m"), nan=np.inf))
    driven = by("trajectory", compared[best])
    with new_figure(path, 10.0, 6.0) as figure:
        halves = figure.add_gridspec(2, 1, height_ratios=(1.0, 1.05))
        upper, lower = figure.add_subfigure(halves[0]), figure.add_subfigure(halves[1])
        upper.suptitle(f"Driven with {best}, first seed")
        paths = upper.subplots(1, len(driven), squeeze=False)[0]
        for axes, (trajectory, runs) in zip(paths, driven.items(), strict=True):
            factor = _path(axes, runs[0])
            drawn = f"\nerror drawn × {factor:g}" if factor > 1 else ""
            axes.set_title(f"{trajectory}, RMSE {1e3 * mean(runs, 'position_rmse_m'):.1f} mm{drawn}")
        paths[0].legend(loc="center")
        errors, times = lower.subplots(1, 2)
        _bars(errors, compared)
        tail_of_step_times(times, outcomes)


def _path(axes: Axes, outcome: Outcome) -> float:
    """Reference and driven path, with its error magnified where they could not be told apart; gives the factor."""
    run = outcome.run
    driven, factor = magnified(run)
    axes.plot(*run.reference_pose[:, :2].T, color=REFERENCE_COLOUR, linewidth=3.0, label="reference")
    axes.plot(*driven.T, color=colour(1), linewidth=1.1, label="driven")
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


def _bars(axes: Axes, compared: dict[str, list[Outcome]]) -> None:
    """Mean position RMSE with the range over trajectories."""
    for i, own in enumerate(compared.values()):
        parts = [1e3 * mean(runs, "position_rmse_m") for runs in by("trajectory", own).values()]
        value = 1e3 * mean(own, "position_rmse_m")
        axes.bar(i, value, 0.6, color=colour(i), alpha=0.85)
        axes.plot([i, i], [min(parts), max(parts)], color="black", linewidth=1.0, marker="_", markersize=8)
        axes.annotate(f"{value:.1f}", (i + 0.06, value), (2, 2), textcoords="offset points", ha="left")
    turned = 20 if len(compared) > 4 else 0
    axes.set_xticks(range(len(compared)), list(compared), rotation=turned, ha="right" if turned else "center")
    axes.set(ylabel="position RMSE [mm]", title="mean, and range over trajectories")
    axes.grid(axis="x", visible=False)


def draw_speed(scores: Sequence[Score], path: Path) -> None:
    """Draw position and lateral RMSE against the top speed, one line per controller, with the range over seeds."""
    with new_figure(path, 10.0, 3.8) as figure:
        panels = figure.subplots(1, 2)
        _errors_against(panels, scores, lambda score: score.case.top_speed or 0.0)
        for axes in panels:
            axes.set_xlabel(f"top speed [m/s] of {' and '.join(by('trajectory', scores))}")
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside right center")


def draw_dead_time(scores: Sequence[Score], sample_time: float, path: Path) -> None:
    """Draw position and lateral RMSE against the plant's dead time less the configured one, a line per controller."""
    with new_figure(path, 10.0, 3.8) as figure:
        panels = figure.subplots(1, 2)
        _errors_against(panels, scores, lambda score: 1e3 * sample_time * score.case.late)
        for axes in panels:
            axes.set_xlabel("dead time of the plant less the configured one [ms]")
            axes.axvline(0.0, color="black", linewidth=0.8, linestyle=":")
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside right center")


def _errors_against(panels: Sequence[Axes], scores: Sequence[Score], key: Callable[[Score], float]) -> None:
    """Mean errors over what is driven at each abscissa, and the range of the seeds' own means."""
    names = group(scores, lambda score: who_drives(score.case))
    for axes, metric in zip(panels, ("position_rmse_m", "lateral_rmse_m"), strict=True):
        for i, (name, runs) in enumerate(names.items()):
            at = dict(sorted(group(runs, key).items()))
            value = np.array([1e3 * mean(part, metric) for part in at.values()])
            seeds = [[1e3 * mean(own, metric) for own in by("seed", part).values()] for part in at.values()]
            spread = [[value[k] - min(own), max(own) - value[k]] for k, own in enumerate(seeds)]
            axes.errorbar(
                list(at),
                value,
                yerr=np.transpose(spread),
                color=colour(i),
                linestyle=line_style(i),
                marker=MARKERS[i % len(MARKERS)],
                markersize=4,
                capsize=3,
                label=name,
            )
        axes.set_ylabel(f"{metric.split('_')[0]} RMSE [mm]")
        _scale(axes)


def draw_horizons(outcomes: Sequence[Outcome], path: Path) -> None:
    """Draw mean position RMSE, and median and 99th percentile of solve and step, against the horizon."""
    with new_figure(path, 10.0, 3.4) as figure:
        position, solve, step = figure.subplots(1, 3)
        for i, (name, own) in enumerate(by_model(outcomes).items()):
            at = by_horizon(own)
            look = {"color": colour(i), "linestyle": line_style(i), "marker": MARKERS[i % len(MARKERS)], "label": name}
            steps = list(at)
            position.plot(steps, [1e3 * mean(runs, "position_rmse_m") for runs in at.values()], **look)
            for axes, of in ((solve, solve_times), (step, step_times)):
                for percent, strength in ((50, 1.0), (99, 0.4)):
                    times = [1e3 * time_percentile(of(runs), percent) for runs in at.values()]
                    axes.plot(steps, times, **look, alpha=strength)
        labels = ("position RMSE [mm]", "solve p50, pale p99 [ms]", "step p50, pale p99 [ms]")
        for axes, label in zip((position, solve, step), labels, strict=True):
            axes.set(xlabel=f"horizon [steps of {1e3 * outcomes[0].run.sample_time:.1f} ms]", ylabel=label)
            _scale(axes)
        position.legend()


def _scale(axes: Axes) -> None:
    """Start at zero, unless one value would press all others flat."""
    values = np.concatenate([np.asarray(line.get_ydata(), dtype=float) for line in axes.get_lines()])
    values = values[np.isfinite(values) & (values > 0)]
    if values.size and values.max() > 20 * values.min():
        axes.set_yscale("log")
    else:
        axes.set_ylim(bottom=0)


def draw_step_times(outcomes: Sequence[Outcome], path: Path) -> None:
    """Draw the share of steps that took longer than a given time, both axes logarithmic so that the tail shows."""
    with new_figure(path, 6.4, 4.0) as figure:
        axes = figure.add_subplot()
        tail_of_step_times(axes, outcomes)
        axes.set_title("Whole step")


def tail_of_step_times(axes: Axes, outcomes: Sequence[Outcome]) -> None:
    """Complementary distribution of the step time on `axes`, with the sample time as a limit."""
    for i, (name, own) in enumerate(by_driver(outcomes).items()):
        times = step_times(own)
        if times.size:  # on a busy machine a short run may have no undisturbed tick
            draw_tail(axes, times, name, colour(i), line_style(i))
    sample = 1e3 * outcomes[0].run.sample_time
    axes.axvline(sample, color="black", linewidth=0.8, linestyle=":")
    axes.axhline(0.01, color="black", linewidth=0.5, alpha=0.5)
    axes.annotate("sample time", (sample, 1.0), (-3, -2), textcoords="offset points", rotation=90, ha="right", va="top")
    axes.set_xlabel("step time [ms]")
    axes.legend(loc="lower left", frameon=True, framealpha=0.8, edgecolor="none")


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
    if run.world is not None:
        draw_world(axes, run.world)
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
