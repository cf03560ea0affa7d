"""What the page of `bench` shows: all runs as linked views, and its figures as charts with the same toggles."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from diffdrive_mpc.bench.comparison.results import ComparisonResults, predictive
from diffdrive_mpc.bench.html_report.configuration import case_config, configuration
from diffdrive_mpc.bench.html_report.numbers import rounded, tail
from diffdrive_mpc.bench.html_report.page import (
    Axis,
    Chart,
    Division,
    KeyFigure,
    Mark,
    Runs,
    Series,
    Shown,
    Toggle,
    Warned,
)
from diffdrive_mpc.bench.html_report.run_series import HOW_TO_READ, PEAKS, run_series
from diffdrive_mpc.bench.html_report.run_warnings import run_warnings
from diffdrive_mpc.bench.outcomes import (
    Outcome,
    S,
    by,
    by_driver,
    by_horizon,
    by_model,
    count,
    group,
    mean,
    step_times,
    time_percentile,
    who_drives,
)
from diffdrive_mpc.bench.table import number

_TICKS = 40_000
"""Ticks of all runs together that the page holds at most, so that it stays small."""
_TICKS_OF_A_RUN = 500
_WARNINGS_SHOWN = 12


def shown(results: ComparisonResults) -> Shown:
    """Everything that the page shows beside the tables."""
    drivers = by_driver(results.main)
    names, paths, seeds = tuple(drivers), tuple(by("trajectory", results.main)), tuple(by("seed", results.main))
    return Shown(
        summary=_sentences(drivers),
        key_figures=_key_figures(results, drivers),
        toggles=[
            Toggle("controller", names, names, styled=True),
            Toggle("path", paths, paths[:1]),
            Toggle("seed", seeds, seeds[:1]),
        ],
        views=[_runs(drivers), *charts(results, names)],
        warnings=_warnings(drivers),
        configurations=[
            one for case in dict.fromkeys(runs[0].case for runs in drivers.values()) for one in configuration(case)
        ],
        pictures=False,
    )


def charts(results: ComparisonResults, names: Sequence[str]) -> list[Chart]:
    """What the figures show: errors by path, step times, and what was swept."""
    made = [_by_path(results), _tail(results)]
    if results.speed:
        title = f"top speed [m/s] of {' and '.join(by('trajectory', results.speed))}"
        made.append(_against("Error against speed", title, results.speed, lambda one: one.case.top_speed or 0.0, names))
    if results.dead_time:
        late = 1e3 * results.main[0].run.sample_time
        title = "dead time beyond the configured one [ms]"
        made.append(
            _against(
                "Error against an unknown dead time", title, results.dead_time, lambda one: late * one.case.late, names
            )
        )
    return made + (_horizons(results.horizon, names) if results.horizon else [])


def _sentences(drivers: Mapping[str, Sequence[Outcome]]) -> list[str]:
    errors = {name: mean(runs, "position_rmse_m") for name, runs in drivers.items()}
    ranked = sorted(errors, key=lambda name: np.nan_to_num(errors[name], nan=np.inf))
    told = ", ".join(f"{name} {number(1e3 * errors[name], 1)}" for name in ranked)
    every = [run for runs in drivers.values() for run in runs]
    done = count(every, "completed")
    first = "All" if done == len(every) else f"{done} of"
    return [
        f"{first} {len(every)} runs came to their end. "
        f"Position RMSE [mm], mean over paths and seeds, the least first: {told}."
    ]


def _key_figures(results: ComparisonResults, drivers: Mapping[str, Sequence[Outcome]]) -> list[KeyFigure]:
    """Those of the predictive controllers, with the other end of the comparison beside the error."""
    ours = predictive(drivers)
    every = [run for runs in ours.values() for run in runs]
    done, fallbacks = count(results.main, "completed"), count(every, "fallbacks")
    errors = {name: mean(runs, "position_rmse_m") for name, runs in drivers.items()}
    best = min(ours, key=lambda name: np.nan_to_num(errors[name], nan=np.inf))
    worst = max(errors, key=lambda name: np.nan_to_num(errors[name], nan=np.inf))
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
        KeyFigure("late steps", str(count(every, "deadline_misses")), f"of {times.size} that were timed; {whose}"),
        KeyFigure("fallbacks", str(fallbacks), "ticks without a fresh plan", "good" if not fallbacks else "bad"),
    ]


def _runs(drivers: Mapping[str, Sequence[Outcome]]) -> Runs:
    """Every run, styled by its controller, the predictive ones first; the more there are, the thinner."""
    number_of_runs = sum(map(len, drivers.values()))
    points = min(_TICKS_OF_A_RUN, _TICKS // number_of_runs)
    series = []
    styles, ours = list(drivers), predictive(drivers)
    for name, runs in (ours | dict(drivers)).items():
        for outcome in runs:
            path, seed = outcome.case.labels["trajectory"], outcome.case.labels["seed"]
            labels = {"controller": name, "path": path, "seed": seed}
            config = case_config(outcome.case)
            series.append(
                run_series(
                    outcome.run,
                    f"{name}, {path}, seed {seed}",
                    points=points,
                    labels=labels,
                    style=styles.index(name),
                    config=config,
                    every_layer=number_of_runs == 1,
                )
            )
    return Runs(series, f"{HOW_TO_READ}; its rows are the runs in their order. {PEAKS}.")


def _labels(name: str, names: Sequence[str]) -> dict[str, str]:
    """What hides a series: its controller's toggle, where it has one."""
    return {"controller": name} if name in names else {}


def _style(name: str, names: Sequence[str]) -> int:
    return names.index(name) if name in names else len(names)


def _by_path(results: ComparisonResults) -> Chart:
    paths = list(by("trajectory", results.main))
    series = []
    for i, (name, runs) in enumerate(by_driver(results.main).items()):
        there = by("trajectory", runs)
        values = [rounded(1e3 * mean(there[path], "position_rmse_m")) if path in there else None for path in paths]
        series.append(Series(name, paths, values, i, "bars", labels={"controller": name}))
    return Chart("Error by path", Axis("path", "category"), Axis("position RMSE [mm]"), series, "Means over seeds.")


def _tail(results: ComparisonResults) -> Chart:
    """The share of steps that took longer than a time."""
    series = []
    for i, (name, runs) in enumerate(by_driver(results.main).items()):
        times = 1e3 * step_times(runs)
        if times.size:
            series.append(Series(name, *tail(times), i, "line", labels={"controller": name}))
    sample = 1e3 * results.main[0].run.sample_time
    note = f"Whole step, from measurement to command. A step has {sample:.1f} ms."
    axes = Axis("step time [ms]", "log"), Axis("share of longer steps", "log")
    return Chart("How long steps take", *axes, series, note, marks=[Mark(0.01, "1 %")])


def _against(title: str, axis: str, scores: Sequence[S], key: Callable[[S], float], names: Sequence[str]) -> Chart:
    """Mean position RMSE at each abscissa, and the range of the seeds' own means."""
    series = []
    for name, runs in group(scores, lambda one: who_drives(one.case)).items():
        at = dict(sorted(group(runs, key).items()))
        seeds = [[1e3 * mean(own, "position_rmse_m") for own in by("seed", part).values()] for part in at.values()]
        values = [rounded(1e3 * mean(part, "position_rmse_m")) for part in at.values()]
        several = all(value is not None for value in values) and any(len(own) > 1 for own in seeds)
        low, high = ([min(own) for own in seeds], [max(own) for own in seeds]) if several else ((), ())
        x = [round(one, 6) for one in at]
        series.append(Series(name, x, values, _style(name, names), low=low, high=high, labels=_labels(name, names)))
    return Chart(title, Axis(axis), Axis("position RMSE [mm]", _scale(series)), series)


def _horizons(outcomes: Sequence[Outcome], names: Sequence[str]) -> list[Chart]:
    errors, times = [], []
    for name, runs in by_model(outcomes).items():
        at = by_horizon(runs)
        style, labels = _style(name, names), _labels(name, names)
        rmse = [rounded(1e3 * mean(part, "position_rmse_m")) for part in at.values()]
        took = [rounded(1e3 * time_percentile(step_times(part), 50)) for part in at.values()]
        errors.append(Series(name, list(at), rmse, style, labels=labels))
        times.append(Series(name, list(at), took, style, labels=labels))
    axis = Axis(f"horizon [steps of {1e3 * outcomes[0].run.sample_time:.1f} ms]")
    return [
        Chart("Error against the horizon", axis, Axis("position RMSE [mm]", _scale(errors)), errors),
        Chart("Step time against the horizon", axis, Axis("step time, median [ms]"), times),
    ]


def _scale(series: Sequence[Series]) -> Division:
    """Logarithmic where one value would press all others flat."""
    values = [value for one in series for value in one.y if isinstance(value, float) and value]
    return "log" if values and max(values) > 20 * min(values) else "linear"


def _warnings(drivers: Mapping[str, Sequence[Outcome]]) -> list[Warned]:
    """Those of every run; where many runs have the same, the first and how many others."""
    found: dict[tuple[str, str], list[Warned]] = {}
    for name, runs in drivers.items():
        for outcome in runs:
            labels = outcome.case.labels
            place = f"{name}, {labels['trajectory']}, seed {labels['seed']}"
            for one in run_warnings(outcome.run, case_config(outcome.case), place):
                found.setdefault((name, one.remedy), []).append(one)
    made = []
    for alike in found.values():
        more = f" The same kind in {len(alike) - 1} more of its runs." if len(alike) > 1 else ""
        made.append(Warned(alike[0].what + more, alike[0].remedy))
    if len(made) > _WARNINGS_SHOWN:
        rest = Warned(f"And {len(made) - _WARNINGS_SHOWN} other kinds of warning: see the tables.")
        return [*made[:_WARNINGS_SHOWN], rest]
    return made
