"""HTML page of `bench` with all runs as linked views, and the figures as charts with the same toggles."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import pandas as pd
from pandas import DataFrame

from diffdrive_mpc.bench.comparison.results import ComparisonResults, best_of, completed_groups, mpc_groups
from diffdrive_mpc.bench.comparison.tables import solve_times, step_times, time_percentile
from diffdrive_mpc.bench.experiment import COMPARED, by, mean, total
from diffdrive_mpc.bench.html_report.origin import configuration, mpc_config
from diffdrive_mpc.bench.html_report.page import (
    Axis,
    Chart,
    Division,
    KeyFigure,
    Mark,
    PageContents,
    PageWarning,
    RunViews,
    Series,
    Toggle,
    round_digits,
    tail_shares,
)
from diffdrive_mpc.bench.html_report.run_series import HOW_TO_READ, PEAKS, run_series
from diffdrive_mpc.bench.html_report.run_warnings import run_warnings
from diffdrive_mpc.bench.table import number

_TICKS = 28_000
"""Maximum total number of ticks of all runs on the page, which limits its size."""
_TICKS_OF_A_RUN = 350
_WARNINGS_SHOWN = 12
_MAX_LINEAR_RATIO = 20
"""Ratio of the largest error to the median above which the axis of errors is logarithmic [-]."""


def page_contents(results: ComparisonResults) -> PageContents:
    """Collect the contents of the page without tables and charts."""
    drivers = by(results.main, COMPARED)
    names, paths, seeds = tuple(drivers), tuple(by(results.main, "trajectory")), tuple(by(results.main, "seed"))
    cases = {rows["case"].iloc[0]: name for name, rows in drivers.items()}
    return PageContents(
        summary=_sentences(results.main, drivers),
        key_figures=_key_figures(results, drivers),
        toggles=[
            Toggle("controller", names, names, styled=True),
            Toggle("path", paths, paths[:1]),
            Toggle("seed", seeds, seeds[:1]),
        ],
        views=[_runs(results.main, drivers), error_chart(results.main)],
        warnings=_warnings(drivers),
        configurations=[view for case, name in cases.items() for view in configuration(case, name)],
        pictures=False,
    )


def charts(results: ComparisonResults) -> dict[str, list[Chart]]:
    """Return charts of step times and sweeps, by the name of the figure file."""
    files = {"step-time.png": [step_time_chart(results.main)]}
    names, sample = list(by(results.main, COMPARED)), results.main["run"].iloc[0].sample_time
    if len(results.speed):
        speeds = [round(case.top_speed or 0.0, 6) for case in results.speed["case"]]
        axis = f"top speed [m/s] of {' and '.join(by(results.speed, 'trajectory'))}"
        files["speed.png"] = _sweep(results.speed, speeds, axis, _errors("Error against speed"), names)
    if len(results.dead_time):
        delays = [round(1e3 * sample * case.late, 6) for case in results.dead_time["case"]]
        axis, title = "additional dead time of the plant [ms]", "Error against an unknown dead time"
        files["dead-time.png"] = _sweep(results.dead_time, delays, axis, _errors(title), names)
    if len(results.horizon):
        axis = f"horizon [steps of {1e3 * sample:.1f} ms]"
        files["horizon.png"] = _sweep(results.horizon, list(results.horizon["horizon"]), axis, _HORIZON_FIGURES, names)
    return files


def _sentences(main: DataFrame, drivers: Mapping[str, DataFrame]) -> list[str]:
    errors = {name: mean(rows, "position_rmse_m") for name, rows in drivers.items()}
    ranked = sorted(completed_groups(drivers), key=errors.__getitem__)
    listed = "; ".join(f"{name} {number(1e3 * errors[name], 1)}" for name in ranked) or "none completed every run"
    others = "; ".join(name for name in drivers if name not in ranked)
    completed = total(main, "completed")
    first = "All" if completed == len(main) else f"{completed} of"
    return [
        f"{first} {len(main)} runs were completed. "
        f"Position RMSE [mm], mean over paths and seeds, in ascending order: {listed}."
        + (f" Not ranked, with runs that did not complete: {others}." if others else "")
    ]


def _key_figures(results: ComparisonResults, drivers: Mapping[str, DataFrame]) -> list[KeyFigure]:
    """Return the key figures of the predictive controllers, and the minimum error of all controllers."""
    groups = mpc_groups(drivers)
    predictive_rows = results.main[results.main["driver"].isin({rows["driver"].iloc[0] for rows in groups.values()})]
    completed, fallbacks = total(results.main, "completed"), total(predictive_rows, "fallbacks")
    times = step_times(predictive_rows)
    controllers, runs = "; ".join(groups), len(results.main)
    percentiles = [number(1e3 * time_percentile(times, share), 2) for share in (50, 99)]
    timed = f"of {times.size} timed steps; {controllers}"
    return [
        KeyFigure("completed", f"{completed} of {runs}", "runs", "good" if completed == runs else "bad"),
        _min_error(drivers),
        KeyFigure("step time, median", f"{percentiles[0]} ms", f"p99 {percentiles[1]} ms; {controllers}"),
        KeyFigure("late steps", str(total(predictive_rows, "deadline_misses")), timed),
        KeyFigure("fallbacks", str(fallbacks), "ticks without a new plan", "good" if not fallbacks else "bad"),
    ]


def _min_error(drivers: Mapping[str, DataFrame]) -> KeyFigure:
    """Return the minimum error of the controllers that completed all runs, with the best MPC if a peer is best."""
    ranked = completed_groups(drivers)
    errors = {name: mean(rows, "position_rmse_m") for name, rows in ranked.items()}
    shown = {name: f"{number(1e3 * error, 1)} mm" for name, error in errors.items()}
    label = "minimum position error, RMSE"
    if not ranked:
        return KeyFigure(label, "-", "no controller completed every run", "bad")
    best, worst = best_of(ranked), max(errors, key=errors.__getitem__)
    groups = {name: rows for name, rows in mpc_groups(drivers).items() if name in ranked}
    if best in groups:
        note = f"worst: {worst} {shown[worst]}" if worst != best else "mean over paths and seeds"
    else:
        note = f"best MPC: {best_of(groups)} {shown[best_of(groups)]}" if groups else "no MPC completed every run"
    return KeyFigure(label, shown[best], f"{best}; {note}")


def _runs(main: DataFrame, drivers: Mapping[str, DataFrame]) -> RunViews:
    """Return views of all runs in the styles of their controllers, starting with predictive controllers.

    The number of points of a run decreases with the number of runs.
    """
    points = min(_TICKS_OF_A_RUN, _TICKS // len(main))
    series = []
    styles, groups = list(drivers), mpc_groups(drivers)
    for name, rows in (groups | dict(drivers)).items():
        for case, run in zip(rows["case"], rows["run"], strict=True):
            path, seed = case.labels["trajectory"], case.labels["seed"]
            series.append(
                run_series(
                    run,
                    f"{name}, {path}, seed {seed}",
                    points=points,
                    labels={"controller": name, "path": path, "seed": seed},
                    style=styles.index(name),
                    config=mpc_config(case),
                )
            )
    return RunViews(series, f"{HOW_TO_READ}. {PEAKS}.")


def error_chart(main: DataFrame) -> Chart:
    """Chart the mean position RMSE of each controller along each path."""
    paths = list(by(main, "trajectory"))
    series = []
    for i, (name, rows) in enumerate(by(main, COMPARED).items()):
        path_rows = by(rows, "trajectory")
        errors = [
            round_digits(1e3 * mean(path_rows[path], "position_rmse_m")) if path in path_rows else None
            for path in paths
        ]
        series.append(Series(name, paths, errors, i, "bars", labels={"controller": name}))
    is_wide = main["position_rmse_m"].max() > _MAX_LINEAR_RATIO * main["position_rmse_m"].median()
    axes = Axis("path", "category"), Axis("position RMSE [mm]", "log" if is_wide else "linear")
    return Chart("Error by path", *axes, series, "Means over seeds.")


def step_time_chart(main: DataFrame) -> Chart:
    """Chart the share of steps that are longer than a time."""
    series = []
    for i, (name, rows) in enumerate(by(main, COMPARED).items()):
        times = 1e3 * step_times(rows)
        if times.size:  # on a busy computer, all ticks of a short run may be disturbed
            series.append(Series(name, *tail_shares(times), i, "line", labels={"controller": name}))
    sample = 1e3 * main["run"].iloc[0].sample_time
    note = f"Whole step, from measurement to command. The sample time is {sample:.1f} ms."
    axes = Axis("step time [ms]", "log"), Axis("share of longer steps", "log")
    marks = [Mark(0.01, "1 %"), Mark(sample, "sample time", upright=True)]
    return Chart("Distribution of step times", *axes, series, note, marks=marks)


Figures = Mapping[str, tuple[str, Callable[[DataFrame], float]]]
"""Title of a chart, title of its y axis, and value of a group of runs."""
_HORIZON_FIGURES: Figures = {
    "Error against the horizon": ("position RMSE [mm]", lambda rows: 1e3 * mean(rows, "position_rmse_m")),
    "Solve time against the horizon": (
        "solve time, p99 [ms]",
        lambda rows: 1e3 * time_percentile(solve_times(rows), 99),
    ),
    "Step time against the horizon": (
        "step time, median [ms]",
        lambda rows: 1e3 * time_percentile(step_times(rows), 50),
    ),
}


def _errors(title: str) -> Figures:
    return {
        f"{title}: position": ("position RMSE [mm]", lambda rows: 1e3 * mean(rows, "position_rmse_m")),
        f"{title}: lateral": ("lateral RMSE [mm]", lambda rows: 1e3 * mean(rows, "lateral_rmse_m")),
    }


def _sweep(rows: DataFrame, x: Sequence[float], axis: str, figures: Figures, names: Sequence[str]) -> list[Chart]:
    """Return charts of `figures` over `x`, with the range over seeds."""
    rows, swept_charts = rows.assign(x=x), []
    for title, (unit, figure) in figures.items():
        series = []
        for name, part in by(rows, "driver").items():
            values = {float(value): round_digits(figure(group)) for value, group in part.groupby("x")}
            seed_values = pd.Series({key: figure(group) for key, group in part.groupby(["x", "seed"])})
            has_range = part["seed"].nunique() > 1 and seed_values.notna().all()
            low, high = (list(seed_values.groupby(level=0).agg(end)) if has_range else () for end in ("min", "max"))
            style = names.index(name) if name in names else len(names)
            labels = {"controller": name} if name in names else {}  # of the toggle that hides the series
            series.append(Series(name, [*values], [*values.values()], style, low=low, high=high, labels=labels))
        swept_charts.append(Chart(title, Axis(axis), Axis(unit, _scale(series)), series))
    return swept_charts


def _scale(series: Sequence[Series]) -> Division:
    """Choose a logarithmic scale if a large value would hide the differences between the other values."""
    values = [value for line in series for value in line.y if isinstance(value, float) and value]
    return "log" if values and max(values) > 20 * min(values) else "linear"


def _warnings(drivers: Mapping[str, DataFrame]) -> list[PageWarning]:
    """Return the warnings of all runs; a repeated warning names its first run and the number of further runs."""
    groups: dict[tuple[str, str], list[PageWarning]] = {}
    for name, rows in drivers.items():
        for case, run in zip(rows["case"], rows["run"], strict=True):
            place = f"{name}, {case.labels['trajectory']}, seed {case.labels['seed']}"
            for run_warning in run_warnings(run, mpc_config(case), place):
                groups.setdefault((name, run_warning.remedy), []).append(run_warning)
    warned = []
    for group in groups.values():
        more = f" The same warning applies to {len(group) - 1} more runs." if len(group) > 1 else ""
        warned.append(PageWarning(group[0].text + more, group[0].remedy))
    if len(warned) > _WARNINGS_SHOWN:
        rest = PageWarning(f"{len(warned) - _WARNINGS_SHOWN} other kinds of warnings: see the tables.")
        return [*warned[:_WARNINGS_SHOWN], rest]
    return warned
