"""What the page of a proof shows: how often it went how, errors of all runs, maps, and where factors stop to hold."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from diffdrive_mpc.app.proof.boundaries import Boundary
from diffdrive_mpc.app.proof.maps import Drawn
from diffdrive_mpc.app.proof.report import CVAR, Outcomes, error_estimates, errors, percent
from diffdrive_mpc.bench.campaign.engine import Driven
from diffdrive_mpc.bench.html_report.numbers import rounded, tail
from diffdrive_mpc.bench.html_report.page import (
    Axis,
    Chart,
    Configuration,
    GridAxis,
    GridMap,
    KeyFigure,
    Mark,
    Series,
    Shown,
    Toggle,
    Warned,
)
from diffdrive_mpc.bench.html_report.run_warnings import remedies
from diffdrive_mpc.bench.statistics import TAIL, Rate
from diffdrive_mpc.bench.table import millis
from diffdrive_mpc.mpc import load_config
from diffdrive_mpc.mpc.config.described import commented_yaml
from diffdrive_mpc.sim.metrics.tracking_errors import metric_settings

_MOST_POINTS = 4000
_WORDS_AGAIN = "drive the worst again with `simulate --from-run worst/01.yaml --out worst/01`, and read its report"


def shown(config: str, driven: Sequence[Driven], boundaries: Sequence[Boundary], seeds: int) -> Shown:
    """Everything that the page shows beside tables, tail and maps.

    Parameters
    ----------
    config
        The controller's configuration.
    driven, boundaries
        What was found.
    seeds
        How many seeds a boundary was tried with.
    """
    scenarios = tuple(dict.fromkeys(str(one.definition.columns["scenario"]) for one in driven))
    of = Outcomes.of(driven)
    toggles = [Toggle("scenario", scenarios, scenarios, styled=True)] if len(scenarios) > 1 else []
    views = [_by_path(driven, scenarios), *(_boundary(one, seeds) for one in boundaries)]
    return Shown(
        summary=[
            f"{of.completed.count} of {of.completed.of} runs came to their end, {of.in_band.count} of them never "
            f"outside the band; {of.unsafe.count or 'none'} had an unsafe command."
        ],
        key_figures=_key_figures(driven),
        toggles=toggles,
        views=views,
        warnings=_warnings(driven, boundaries),
        configurations=[Configuration("Configuration that was proven (YAML)", commented_yaml(load_config(config)))],
    )


def _key_figures(driven: Sequence[Driven]) -> list[KeyFigure]:
    of, tail = Outcomes.of(driven), error_estimates(driven)[f"{CVAR}, completed runs"]
    bound = f"with 95 % confidence fewer than {percent(of.unsafe.bound)} %"
    return [
        KeyFigure("completed", f"{100 * of.completed.share:.1f} %", _interval(of.completed)),
        KeyFigure("completed inside the band", f"{100 * of.in_band.share:.1f} %", _interval(of.in_band)),
        KeyFigure("stopped by itself", f"{100 * of.stopped.share:.1f} %", _interval(of.stopped)),
        KeyFigure("unsafe commands", f"{of.unsafe.count} runs", bound, "bad" if of.unsafe.count else "good"),
        KeyFigure("position error, worst twentieth", f"{millis(tail.value)} mm", "CVaR 95 % of completed runs, RMSE"),
    ]


def _interval(rate: Rate) -> str:
    return f"{rate.count} of {rate.of}; 95 %: {100 * rate.low:.1f} to {100 * rate.high:.1f} %"


def tail_charts(driven: Sequence[Driven]) -> list[Chart]:
    """The share of completed runs with a larger error than a given one, and CVaR; empty without such runs."""
    found = 1e3 * errors([one for one in driven if one.row["completed"] is True])
    if not found.size:
        return []
    worst = 1e3 * error_estimates(driven)[f"{CVAR}, completed runs"].value
    series = Series("completed runs", *tail(found), 0, "line")
    axes = Axis("position RMSE [mm]", "log"), Axis("share of completed runs with more", "log")
    marks = [Mark(TAIL, f"{100 * TAIL:g} %"), Mark(round(worst, 2), f"{CVAR}: {worst:.1f} mm", upright=True)]
    return [Chart("How large the error is", *axes, [series], marks=marks)]


def _by_path(driven: Sequence[Driven], scenarios: Sequence[str]) -> Chart:
    """A point for each run; where there are too many, the worst."""
    ordered = sorted(driven, key=lambda one: -np.nan_to_num(one.number("position_rmse_m")))[:_MOST_POINTS]
    series = []
    for i, name in enumerate(scenarios):
        own = [one for one in ordered if str(one.definition.columns["scenario"]) == name]
        rmse = [rounded(1e3 * one.number("position_rmse_m")) for one in own]
        paths = [str(one.definition.columns["trajectory"]) for one in own]
        labels = {"scenario": name} if len(scenarios) > 1 else {}
        text = [f"{path}, {name}: {value} mm" for path, value in zip(paths, rmse, strict=True)]
        series.append(Series(name, paths, rmse, i, "points", text=text, labels=labels))
    left_out = f"The {_MOST_POINTS} worst runs." if len(driven) > _MOST_POINTS else "All runs."
    axes = Axis("path", "category"), Axis("position RMSE [mm]", "log")
    return Chart("Every run, by path and scenario", *axes, series, left_out)


def map_chart(drawn: Drawn) -> GridMap:
    """Position error by two factors."""
    x, y = drawn.of.x, drawn.of.y
    values = [[rounded(1e3 * value) for value in row] for row in drawn.error]
    return GridMap(
        drawn.name.replace("-", " ").capitalize(),
        GridAxis(x.factor, x.values),
        GridAxis(y.factor, y.values),
        values,
        "position RMSE [mm]",
        (drawn.completed == 0.0).tolist(),
        "Colours are logarithmic; ×: the run did not come to its end.",
    )


def _boundary(one: Boundary, seeds: int) -> Chart:
    tried = sorted(one.values.items())
    series = Series("seeds", [value for value, _ in tried], [float(count) for _, count in tried], 0)
    unit = f" [{one.search.unit}]" if one.search.unit else ""
    held = "-" if one.held is None else f"{one.held:.4g}"
    note = f"It holds up to {held}{unit}; each value was tried with {seeds} seeds."
    axes = Axis(f"{one.factor}{unit}"), Axis("seeds with which it holds", range=(-0.1 * seeds, 1.1 * seeds))
    return Chart(f"Where it stops to hold: {one.factor}", *axes, [series], note, height=280)


def _warnings(driven: Sequence[Driven], boundaries: Sequence[Boundary]) -> list[Warned]:
    of, found = Outcomes.of(driven), []
    failed = sum(one.row["error"] != "" for one in driven)
    band = f"{1e3 * metric_settings().band:g} mm"
    if of.unsafe.count:
        words = f"{of.unsafe.count} runs had an unsafe command: not finite, or beyond what the configuration allows."
        found.append(Warned(words, f"do not drive with it; {_WORDS_AGAIN}, and send it to the authors"))
    if failed:
        found.append(Warned(f"{failed} runs ended in an error and count as not completed.", _WORDS_AGAIN))
    if of.stopped.count:
        words = f"In {of.stopped.count} runs the robot stopped by itself: safe, but not at its end."
        found.append(Warned(words, f"look in the tables which scenario that is; {remedies().waited}"))
    beyond = of.completed.count - of.in_band.count
    if beyond:
        words = f"{beyond} completed runs were further than {band} from the path at some time."
        found.append(Warned(words, f"leave that much room beside the path, or drive slower; {_WORDS_AGAIN}"))
    for one in boundaries:
        if one.held is None:
            words = f"{one.factor}: not even {one.search.holds:g} holds, which should."
            found.append(Warned(words, "look at the maps for what else is at its limit there"))
    return found
