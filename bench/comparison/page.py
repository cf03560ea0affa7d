"""What the page of `bench` shows: all runs as linked views, and its figures as charts with the same toggles."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from pandas import DataFrame

from diffdrive_mpc.bench.case import Case
from diffdrive_mpc.bench.comparison.results import ComparisonResults, best_of, predictive
from diffdrive_mpc.bench.comparison.tables import solve_times, step_times, time_percentile
from diffdrive_mpc.bench.experiment import COMPARED, by, mean, total
from diffdrive_mpc.bench.html_report.origin import case_config, configuration
from diffdrive_mpc.bench.html_report.page import (
    Axis,
    Chart,
    Division,
    KeyFigure,
    Mark,
    RunViews,
    Series,
    Shown,
    Toggle,
    Warned,
    rounded,
    tail,
)
from diffdrive_mpc.bench.html_report.run_series import HOW_TO_READ, PEAKS, run_series
from diffdrive_mpc.bench.html_report.run_warnings import run_warnings
from diffdrive_mpc.bench.table import number

_TICKS = 40_000
"""Ticks of all runs together that the page holds at most, so that it stays small."""
_TICKS_OF_A_RUN = 500
_WARNINGS_SHOWN = 12


def shown(results: ComparisonResults) -> Shown:
    """Everything that the page shows beside tables and charts."""
    drivers = by(results.main, COMPARED)
    names, paths, seeds = tuple(drivers), tuple(by(results.main, "trajectory")), tuple(by(results.main, "seed"))
    cases = dict.fromkeys(rows["case"].iloc[0] for rows in drivers.values())
    return Shown(
        summary=_sentences(results.main, drivers),
        key_figures=_key_figures(results, drivers),
        toggles=[
            Toggle("controller", names, names, styled=True),
            Toggle("path", paths, paths[:1]),
            Toggle("seed", seeds, seeds[:1]),
        ],
        views=[_runs(results.main, drivers), error_chart(results.main)],
        warnings=_warnings(drivers),
        configurations=[one for case in cases for one in configuration(case)],
        pictures=False,
    )


def charts(results: ComparisonResults) -> dict[str, list[Chart]]:
    """Step times, and what was swept, by the name of the figure in which they stand."""
    made = {"step-time.png": [step_time_chart(results.main)]}
    names, sample = list(by(results.main, COMPARED)), results.main["run"].iloc[0].sample_time
    if len(results.speed):
        axis = f"top speed [m/s] of {' and '.join(by(results.speed, 'trajectory'))}"
        made["speed.png"] = _against(
            "Error against speed", axis, results.speed, lambda row: row.top_speed or 0.0, names
        )
    if len(results.dead_time):
        title, axis = "Error against an unknown dead time", "dead time beyond the configured one [ms]"
        made["dead-time.png"] = _against(title, axis, results.dead_time, lambda row: 1e3 * sample * row.late, names)
    if len(results.horizon):
        made["horizon.png"] = _horizons(results.horizon, sample, names)
    return made


def _sentences(main: DataFrame, drivers: Mapping[str, DataFrame]) -> list[str]:
    errors = {name: mean(rows, "position_rmse_m") for name, rows in drivers.items()}
    ranked = sorted(errors, key=lambda name: errors[name] if errors[name] == errors[name] else float("inf"))
    listed = ", ".join(f"{name} {number(1e3 * errors[name], 1)}" for name in ranked)
    done = total(main, "completed")
    first = "All" if done == len(main) else f"{done} of"
    return [
        f"{first} {len(main)} runs came to their end. "
        f"Position RMSE [mm], mean over paths and seeds, the least first: {listed}."
    ]


def _key_figures(results: ComparisonResults, drivers: Mapping[str, DataFrame]) -> list[KeyFigure]:
    """Those of the predictive controllers, with the other end of the comparison beside the error."""
    ours = predictive(drivers)
    every = results.main[results.main["driver"].isin({rows["driver"].iloc[0] for rows in ours.values()})]
    done, fallbacks = total(results.main, "completed"), total(every, "fallbacks")
    errors = {name: mean(rows, "position_rmse_m") for name, rows in drivers.items()}
    best = best_of(ours)
    worst = max(errors, key=lambda name: errors[name] if errors[name] == errors[name] else float("inf"))
    times = step_times(every)
    against = f"{worst}: {number(1e3 * errors[worst], 1)} mm" if worst != best else "mean over paths and seeds"
    whose = ", ".join(ours)
    return [
        KeyFigure(
            "completed", f"{done} of {len(results.main)}", "runs", "good" if done == len(results.main) else "bad"
        ),
        KeyFigure("least position error, RMSE", f"{number(1e3 * errors[best], 1)} mm", f"{best}; {against}"),
        KeyFigure(
            "step time, median",
            f"{number(1e3 * time_percentile(times, 50), 2)} ms",
            f"p99 {number(1e3 * time_percentile(times, 99), 2)} ms; {whose}",
        ),
        KeyFigure("late steps", str(total(every, "deadline_misses")), f"of {times.size} that were timed; {whose}"),
        KeyFigure("fallbacks", str(fallbacks), "ticks without a fresh plan", "good" if not fallbacks else "bad"),
    ]


def _runs(main: DataFrame, drivers: Mapping[str, DataFrame]) -> RunViews:
    """Every run, styled by its controller, the predictive ones first; the more there are, the thinner."""
    points = min(_TICKS_OF_A_RUN, _TICKS // len(main))
    series = []
    styles, ours = list(drivers), predictive(drivers)
    for name, rows in (ours | dict(drivers)).items():
        for case, run in zip(rows["case"], rows["run"], strict=True):
            path, seed = case.labels["trajectory"], case.labels["seed"]
            series.append(
                run_series(
                    run,
                    f"{name}, {path}, seed {seed}",
                    points=points,
                    labels={"controller": name, "path": path, "seed": seed},
                    style=styles.index(name),
                    config=case_config(case),
                )
            )
    return RunViews(series, f"{HOW_TO_READ}. {PEAKS}.")


def error_chart(main: DataFrame) -> Chart:
    """Mean position RMSE of each controller along each path."""
    paths = list(by(main, "trajectory"))
    series = []
    for i, (name, rows) in enumerate(by(main, COMPARED).items()):
        there = by(rows, "trajectory")
        errors = [rounded(1e3 * mean(there[path], "position_rmse_m")) if path in there else None for path in paths]
        series.append(Series(name, paths, errors, i, "bars", labels={"controller": name}))
    return Chart("Error by path", Axis("path", "category"), Axis("position RMSE [mm]"), series, "Means over seeds.")


def step_time_chart(main: DataFrame) -> Chart:
    """The share of steps that took longer than a time."""
    series = []
    for i, (name, rows) in enumerate(by(main, COMPARED).items()):
        times = 1e3 * step_times(rows)
        if times.size:  # on a busy machine a short run may have no undisturbed tick
            series.append(Series(name, *tail(times), i, "line", labels={"controller": name}))
    sample = 1e3 * main["run"].iloc[0].sample_time
    note = f"Whole step, from measurement to command. A step has {sample:.1f} ms."
    axes = Axis("step time [ms]", "log"), Axis("share of longer steps", "log")
    marks = [Mark(0.01, "1 %"), Mark(sample, "sample time", upright=True)]
    return Chart("How long steps take", *axes, series, note, marks=marks)


def _against(title: str, axis: str, rows: DataFrame, key: Callable[[Case], float], names: Sequence[str]) -> list[Chart]:
    """Mean position and lateral RMSE at each abscissa, and the range of the seeds' own means."""
    at = rows.assign(at=[round(key(case), 6) for case in rows["case"]]).sort_values("at", kind="stable")
    made = []
    for metric in ("position", "lateral"):
        series = []
        for name, own in by(at, "driver").items():
            seeds = own.groupby(["at", "seed"])[f"{metric}_rmse_m"].apply(lambda row: 1e3 * row.mean(skipna=False))
            value = [1e3 * mean(part, f"{metric}_rmse_m") for _, part in own.groupby("at")]
            several = seeds.notna().all() and len(by(own, "seed")) > 1
            low, high = (list(seeds.groupby("at").agg(end)) if several else () for end in ("min", "max"))
            x, y = list(own["at"].unique()), [rounded(one) for one in value]
            series.append(Series(name, x, y, _style(name, names), low=low, high=high, labels=_labels(name, names)))
        made.append(Chart(f"{title}: {metric}", Axis(axis), Axis(f"{metric} RMSE [mm]", _scale(series)), series))
    return made


def _horizons(rows: DataFrame, sample_time: float, names: Sequence[str]) -> list[Chart]:
    axis = Axis(f"horizon [steps of {1e3 * sample_time:.1f} ms]")
    figures: dict[str, tuple[str, Callable[[DataFrame], float]]] = {
        "Error against the horizon": ("position RMSE [mm]", lambda part: 1e3 * mean(part, "position_rmse_m")),
        "Solve time against the horizon": (
            "solve time, p99 [ms]",
            lambda part: 1e3 * time_percentile(solve_times(part), 99),
        ),
        "Step time against the horizon": (
            "step time, median [ms]",
            lambda part: 1e3 * time_percentile(step_times(part), 50),
        ),
    }
    made = []
    for title, (unit, figure) in figures.items():
        series = []
        for name, own in by(rows.sort_values("horizon", kind="stable"), "driver").items():
            at = {int(steps): rounded(figure(part)) for steps, part in own.groupby("horizon")}
            style, labels = _style(name, names), _labels(name, names)
            series.append(Series(name, list(at), list(at.values()), style, labels=labels))
        made.append(Chart(title, axis, Axis(unit, _scale(series)), series))
    return made


def _labels(name: str, names: Sequence[str]) -> dict[str, str]:
    """What hides a series: its controller's toggle, where it has one."""
    return {"controller": name} if name in names else {}


def _style(name: str, names: Sequence[str]) -> int:
    return names.index(name) if name in names else len(names)


def _scale(series: Sequence[Series]) -> Division:
    """Logarithmic where one value would press all others flat."""
    values = [value for one in series for value in one.y if isinstance(value, float) and value]
    return "log" if values and max(values) > 20 * min(values) else "linear"


def _warnings(drivers: Mapping[str, DataFrame]) -> list[Warned]:
    """Those of every run; where many runs have the same, the first and how many others."""
    warned: dict[tuple[str, str], list[Warned]] = {}
    for name, rows in drivers.items():
        for case, run in zip(rows["case"], rows["run"], strict=True):
            place = f"{name}, {case.labels['trajectory']}, seed {case.labels['seed']}"
            for run_warning in run_warnings(run, case_config(case), place):
                warned.setdefault((name, run_warning.remedy), []).append(run_warning)
    made = []
    for alike in warned.values():
        more = f" The same kind in {len(alike) - 1} more of its runs." if len(alike) > 1 else ""
        made.append(Warned(alike[0].what + more, alike[0].remedy))
    if len(made) > _WARNINGS_SHOWN:
        rest = Warned(f"And {len(made) - _WARNINGS_SHOWN} other kinds of warning: see the tables.")
        return [*made[:_WARNINGS_SHOWN], rest]
    return made
