"""What the page of a tuning shows: whether it is better, the points that were tried, and what each parameter buys."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import yaml

from diffdrive_mpc.app.tune.points import Point, Searched
from diffdrive_mpc.app.tune.verdict import Verdict
from diffdrive_mpc.bench.campaign.draws import Value
from diffdrive_mpc.bench.html_report.numbers import rounded
from diffdrive_mpc.bench.html_report.page import Axis, Chart, Configuration, KeyFigure, Mark, Series, Shown, Warned
from diffdrive_mpc.bench.statistics import Estimate
from diffdrive_mpc.bench.table import number
from diffdrive_mpc.mpc import load_config
from diffdrive_mpc.mpc.config.described import commented_yaml

_NOT_BETTER = "keep the defaults, which config.yaml holds; search longer (--points), or change the plan"


def shown(config: str, searched: Searched, verdict: Verdict, usual: Mapping[str, Value]) -> Shown:
    """Everything that the page shows beside the tables, the front and the search.

    Parameters
    ----------
    config
        The configuration that was started from.
    searched, verdict
        What was found.
    usual
        Values that the defaults have.
    """
    charts = [_importance(searched)] if searched.importance else []
    charts += [_put_back(verdict)] if verdict.put_back else []
    best = {key: value for key, value in searched.best.values.items() if value != usual[key]}
    changed = yaml.safe_dump(best, sort_keys=False) if best else "# none: the defaults are the best point\n"
    return Shown(
        key_figures=_key_figures(searched, verdict),
        views=charts,
        warnings=_warnings(searched, verdict),
        configurations=[
            Configuration("Values of the best point that are not those of the defaults (YAML)", changed),
            Configuration("Configuration that was started from (YAML)", commented_yaml(load_config(config))),
        ],
    )


def _key_figures(searched: Searched, verdict: Verdict) -> list[KeyFigure]:
    gain = verdict.gain
    whole = Estimate(1.0 - gain.value, 1.0 - gain.high, 1.0 - gain.low)
    named = {"objective": whole, "error": verdict.error, "effort": verdict.effort}
    better = KeyFigure(
        "better than the defaults",
        "yes" if verdict.improved else "no",
        f"on {verdict.runs} runs that the search has not seen",
        "good" if verdict.improved else "",
    )
    changes = [
        KeyFigure(name, f"{100 * (one.value - 1.0):+.1f} %", f"95 %: {_percent(one.low)} to {_percent(one.high)}")
        for name, one in named.items()
        if math.isfinite(one.value)
    ]
    return [better, *changes, KeyFigure("points tried", str(len(searched.points)), f"{len(searched.usable)} usable")]


def _percent(ratio: float) -> str:
    return f"{100 * (ratio - 1.0):+.1f} %" if math.isfinite(ratio) else "-"


def front_chart(searched: Searched) -> Chart:
    """Error and effort of the usable points, the front, the defaults and the chosen point."""
    sides = {
        "came through all fidelities": (searched.usable, 5, "points"),
        "no point is better in both": (searched.front, 0, "both"),
        "defaults": (searched.points[:1], 1, "points"),
        "chosen": ([searched.best], 2, "points"),
    }
    series = [
        Series(
            name,
            [rounded(one.effort) or 0.0 for one in points],
            [rounded(one.error) for one in points],
            style,
            kind,  # type: ignore[arg-type]
            text=[_told(one) for one in points],
        )
        for name, (points, style, kind) in sides.items()
    ]
    axes = Axis("effort, over that of the defaults"), Axis("error, over that of the defaults")
    return Chart("Error against effort", *axes, series, "Point at one for its values.")


def search_chart(searched: Searched) -> Chart:
    """The objective of every point, and the best usable one so far."""
    series = []
    for fidelity in sorted({one.fidelity for one in searched.points if one.fidelity}):
        some = [one for one in searched.points if one.fidelity == fidelity]
        numbers, values = [float(one.number) for one in some], [rounded(one.value) for one in some]
        series.append(
            Series(f"fidelity {fidelity}", numbers, values, fidelity, "points", text=[_told(one) for one in some])
        )
    best = np.minimum.accumulate([one.value for one in searched.usable])
    so_far = Series(
        "best so far", [float(one.number) for one in searched.usable], [rounded(one) for one in best], 0, "line"
    )
    axes = Axis("point"), Axis("objective, over that of the defaults", "log")
    return Chart("How the search went", *axes, [*series, so_far], "Each point at the last fidelity it was driven with.")


def _importance(searched: Searched) -> Chart:
    names, shares = list(searched.importance), [round(100 * one, 1) for one in searched.importance.values()]
    note = "How much each decides whether a point is among the best tenth, over the range that was searched."
    axes = Axis("parameter", "category"), Axis("importance [%]")
    return Chart("Which parameters matter", *axes, [Series("importance", names, shares, 0, "bars")], note)


def _put_back(verdict: Verdict) -> Chart:
    names = [one.key for one in verdict.put_back]
    rises = [one.rise for one in verdict.put_back]
    value, low, high = ([round(100 * getattr(one, of), 2) for one in rises] for of in ("value", "low", "high"))
    several = np.isfinite([low, high]).all()
    series = Series("objective", names, value, 0, "points", low if several else (), high if several else ())
    note = "Rise of the objective where that parameter alone is put back to its default, with 95 % intervals."
    axes = Axis("parameter", "category"), Axis("rise of the objective [%]")
    return Chart("What each parameter buys", *axes, [series], note, [Mark(0.0, "no difference")])


def _warnings(searched: Searched, verdict: Verdict) -> list[Warned]:
    found = []
    if verdict.broken:
        found.append(Warned(f"On runs of other seeds the best point breaks {verdict.broken}.", _NOT_BETTER))
    elif not verdict.improved:
        found.append(Warned(f"It is {verdict.sentence}.", _NOT_BETTER))
    if verdict.usual_broken:
        words = f"The defaults break {verdict.usual_broken}."
        found.append(Warned(words, "the plan asks for more than they were made for; see its constraints"))
    idle = [one.key for one in verdict.put_back if one.rise.high <= 0.0]
    if idle and verdict.improved:
        words = f"Put back to its default, each of these would be better or the same: {', '.join(idle)}."
        found.append(Warned(words, "put them back in config.yaml by hand: fewer changes are easier to trust"))
    broken = sum(bool(one.broken) for one in searched.points)
    if 2 * broken > len(searched.points):
        words = f"{broken} of {len(searched.points)} points broke what has to hold."
        found.append(Warned(words, "narrow the ranges in the plan, so that the search does not waste its runs"))
    return found


def _told(point: Point) -> str:
    values = ", ".join(f"{key} {_value(value)}" for key, value in point.values.items())
    return f"point {point.number}, objective {number(point.value, 3)}: {values}"


def _value(value: Value) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)
