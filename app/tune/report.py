"""The tables of a tuning, the sentences above them, and the configuration that it gives."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import yaml

from diffdrive_mpc.app.tune.search import Searched, TunePoint
from diffdrive_mpc.app.tune.tune_file import TunePlan
from diffdrive_mpc.app.tune.verdict import PutBack, TuneVerdict
from diffdrive_mpc.bench.html_report.page import (
    Axis,
    Chart,
    ConfigurationView,
    KeyFigure,
    Mark,
    Series,
    Shown,
    Warned,
    rounded,
)
from diffdrive_mpc.bench.statistics import BootstrapEstimate
from diffdrive_mpc.bench.table import Table, number
from diffdrive_mpc.models.whole_file import whole_file
from diffdrive_mpc.mpc import ControllerConfig, load_config
from diffdrive_mpc.mpc.config.described import commented_yaml
from diffdrive_mpc.mpc.config.rooms import plain_key
from diffdrive_mpc_extras.campaign.draws import Value

_LISTED = 12


def facts(plan: TunePlan, searched: Searched, verdict: TuneVerdict) -> list[str]:
    """Summarise the result and the runs."""
    through = [sum(point.fidelity > k for point in searched.points) for k in range(len(plan.fidelities))]
    runs = " / ".join(str(fidelity.runs) for fidelity in plan.fidelities)
    broken = [point for point in searched.points if point.broken]
    lines = [
        f"{verdict.sentence[0].upper()}{verdict.sentence[1:]}.",
        f"{len(searched.points)} points, the defaults first; {' / '.join(map(str, through))} of them driven with "
        f"{runs} runs each, {len(searched.usable)} came through all; {len(broken)} broke what has to hold.",
    ]
    if plan.step_time is not None:
        stated = plan.step_time
        lines.append(
            f"Step time on {stated.machine}: p99 {1e3 * stated.p99:.3g} ms as stated for the defaults, at most "
            f"{1e3 * stated.at_most:.3g} ms allowed; of a point: that times its processor time here over that of the "
            "defaults."
        )
    return lines


def tables(searched: Searched, verdict: TuneVerdict, usual: Mapping[str, Value]) -> list[Table]:
    """All tables of a tuning."""
    made = [_verdict(verdict), _chosen(searched, verdict, usual)]
    if verdict.put_back:
        made.append(_put_back(verdict))
    return [*made, _front(searched)]


def configuration(
    config: str, searched: Searched, verdict: TuneVerdict, plan: TunePlan, usual: Mapping[str, Value], path: Path
) -> None:
    """Write the chosen configuration, or the defaults where it is no better; raises ConfigError if that cannot be.

    Files that it names are named by their path from its folder.
    """
    chosen = searched.best.values if verdict.improved else {}
    other = {key: value for key, value in chosen.items() if value != usual[key]}
    tuned = _beside(load_config(config, other), path.parent)
    worth = {parameter.key: parameter for parameter in verdict.put_back}
    notes = {plain_key(key): _note(usual[key], worth.get(key)) for key in other}
    head = [
        f"Tuned from {Path(config).name}: {verdict.sentence}.",
        f"Plan: {plan.description}; {len(searched.points)} points, seeds from {plan.tuning.first_seed} on; verdict "
        f"with seeds from {plan.verdict.first_seed} on.",
    ]
    head += ["Values that changed say what they were."] if other else ["All values are what they were."]
    with whole_file(path) as draft:
        draft.write_text("".join(f"# {line}\n" for line in head) + commented_yaml(tuned, notes), encoding="utf-8")


def _note(usual: Value, worth: PutBack | None) -> str:
    was = f"was {usual:g}" if isinstance(usual, (int, float)) else f"was {usual}"
    return was if worth is None else f"{was}, with which the objective is {_points(worth.rise)}"


def _points(of: BootstrapEstimate) -> str:
    """A difference of the objective in percent of that of the defaults, in words."""
    if not math.isfinite(of.value):
        return "unknown"
    return f"{100 * abs(of.value):.1f} % {'higher' if of.value >= 0.0 else 'lower'}"


def _beside(config: ControllerConfig, folder: Path) -> ControllerConfig:
    def named(file: str) -> str:
        return os.path.relpath(file, folder) if Path(file).is_file() else file

    terms = [term.model_copy(update={"file": named(term.file)}) for term in config.terms]
    return config.model_copy(update={"model": named(config.model), "terms": terms})


def _verdict(verdict: TuneVerdict) -> Table:
    rows = [
        (
            f"{figure.term.column}, {figure.term.figure}",
            f"{100 * figure.term.weight:.0f} %",
            f"{figure.usual:.4g}",
            f"{figure.mine:.4g}",
            _change(figure.ratio),
            _interval(figure.ratio),
        )
        for figure in verdict.figures
    ]
    for name, side in (("error", verdict.error), ("effort", verdict.effort)):
        if math.isfinite(side.value):
            rows.append((name, "", "1", number(side.value, 3), _change(side), _interval(side)))
    gain = verdict.gain
    whole = BootstrapEstimate(1.0 - gain.value, 1.0 - gain.high, 1.0 - gain.low)
    rows.append(("objective", "", "1", number(whole.value, 3), _change(whole), _interval(whole)))
    return Table(
        "Verdict",
        ("figure", "weight", "defaults", "chosen", "change [%]", "95 % interval [%]"),
        tuple(rows),
        1,
        f"{verdict.runs} runs of each with seeds that the search has not seen, paired run by run; intervals: bootstrap "
        "of 2000 samples. Figures are in the unit of their column; error, effort and objective are weighted ratios.",
    )


def _change(ratio: BootstrapEstimate) -> str:
    return f"{100 * (ratio.value - 1.0):+.1f}"


def _interval(ratio: BootstrapEstimate) -> str:
    return f"{100 * (ratio.low - 1.0):+.1f} to {100 * (ratio.high - 1.0):+.1f}"


def _chosen(searched: Searched, verdict: TuneVerdict, usual: Mapping[str, Value]) -> Table:
    best = searched.best
    rows = [
        (key, _value(usual[key]), _value(best.values[key]), number(100 * searched.importance.get(key, math.nan), 1))
        for key in sorted(usual, key=lambda key: -searched.importance.get(key, 0.0))
    ]
    note = (
        "Importance: how much a parameter decides whether a point is among the best tenth with the first fidelity "
        "(PED-ANOVA, Watanabe et al., IJCAI 2023), over the whole range that was searched; the shares add up to 100."
    )
    if not verdict.improved:
        note += " The chosen point is not written: config.yaml holds the defaults."
    columns = ("parameter", "defaults", "chosen", "importance [%]")
    return Table("Chosen point", columns, tuple(rows), 1, note)


def _put_back(verdict: TuneVerdict) -> Table:
    def cell(of: BootstrapEstimate) -> str:
        return f"{100 * of.value:+.1f} ({100 * of.low:+.1f} to {100 * of.high:+.1f})"

    rows = tuple(
        (parameter.key, _value(parameter.usual), cell(parameter.rise), cell(parameter.error), cell(parameter.effort))
        for parameter in verdict.put_back
    )
    return Table(
        "What each parameter buys",
        ("put back", "to", "objective", "error", "effort"),
        rows,
        1,
        "The chosen point with one parameter alone as the defaults have it: rise of the objective and its sides, in "
        "percent of those of the defaults, with 95 % intervals, on runs of the verdict. Below zero: better put back.",
    )


def _front(searched: Searched) -> Table:
    named = {searched.best.number: "chosen", 0: "defaults"}
    rows = [(str(point.number), named.get(point.number, ""), *_score(point)) for point in searched.front[:_LISTED]]
    more = len(searched.front) - len(rows)
    note = "Usable points that no other beats in both error and effort, on the runs of the last fidelity."
    return Table(
        "Error against effort",
        ("point", "", "error", "effort", "objective"),
        tuple(rows),
        2,
        note + (f" {more} more are in tune.json." if more else ""),
    )


def _score(point: TunePoint) -> tuple[str, str, str]:
    return number(point.error, 3), number(point.effort, 3), number(point.value, 3)


def _value(value: Value) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


# What the page of a tuning shows: whether it is better, the points that were tried, and what each parameter buys.


_NOT_BETTER = "keep the defaults, which config.yaml holds; search longer (--points), or change the plan"


def shown(config: str, searched: Searched, verdict: TuneVerdict, usual: Mapping[str, Value]) -> Shown:
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
    charts += [_page_put_back(verdict)] if verdict.put_back else []
    best = {key: value for key, value in searched.best.values.items() if value != usual[key]}
    changed = yaml.safe_dump(best, sort_keys=False) if best else "# none: the defaults are the best point\n"
    return Shown(
        key_figures=_key_figures(searched, verdict),
        views=charts,
        warnings=_warnings(searched, verdict),
        configurations=[
            ConfigurationView("Values of the best point that are not those of the defaults (YAML)", changed),
            ConfigurationView("Configuration that was started from (YAML)", commented_yaml(load_config(config))),
        ],
    )


def _key_figures(searched: Searched, verdict: TuneVerdict) -> list[KeyFigure]:
    gain = verdict.gain
    whole = BootstrapEstimate(1.0 - gain.value, 1.0 - gain.high, 1.0 - gain.low)
    named = {"objective": whole, "error": verdict.error, "effort": verdict.effort}
    better = KeyFigure(
        "better than the defaults",
        "yes" if verdict.improved else "no",
        f"on {verdict.runs} runs that the search has not seen",
        "good" if verdict.improved else "",
    )
    changes = [
        KeyFigure(
            name, f"{100 * (figure.value - 1.0):+.1f} %", f"95 %: {_percent(figure.low)} to {_percent(figure.high)}"
        )
        for name, figure in named.items()
        if math.isfinite(figure.value)
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
            [rounded(point.effort) or 0.0 for point in points],
            [rounded(point.error) for point in points],
            style,
            kind,  # type: ignore[arg-type]
            text=[_told(point) for point in points],
        )
        for name, (points, style, kind) in sides.items()
    ]
    axes = Axis("effort, over that of the defaults"), Axis("error, over that of the defaults")
    return Chart("Error against effort", *axes, series, "Point at one for its values.")


def search_chart(searched: Searched) -> Chart:
    """The objective of every point, and the best usable one so far."""
    series = []
    for fidelity in sorted({point.fidelity for point in searched.points if point.fidelity}):
        some = [point for point in searched.points if point.fidelity == fidelity]
        numbers, values = [float(point.number) for point in some], [rounded(point.value) for point in some]
        series.append(
            Series(f"fidelity {fidelity}", numbers, values, fidelity, "points", text=[_told(point) for point in some])
        )
    best = np.minimum.accumulate([point.value for point in searched.usable])
    so_far = Series(
        "best so far", [float(point.number) for point in searched.usable], [rounded(point) for point in best], 0, "line"
    )
    axes = Axis("point"), Axis("objective, over that of the defaults", "log")
    return Chart("How the search went", *axes, [*series, so_far], "Each point at the last fidelity it was driven with.")


def _importance(searched: Searched) -> Chart:
    names, shares = list(searched.importance), [round(100 * share, 1) for share in searched.importance.values()]
    note = "How much each decides whether a point is among the best tenth, over the range that was searched."
    axes = Axis("parameter", "category"), Axis("importance [%]")
    return Chart("Which parameters matter", *axes, [Series("importance", names, shares, 0, "bars")], note)


def _page_put_back(verdict: TuneVerdict) -> Chart:
    names = [parameter.key for parameter in verdict.put_back]
    rises = [parameter.rise for parameter in verdict.put_back]
    value, low, high = ([round(100 * getattr(rise, of), 2) for rise in rises] for of in ("value", "low", "high"))
    several = np.isfinite([low, high]).all()
    series = Series("objective", names, value, 0, "points", low if several else (), high if several else ())
    note = "Rise of the objective where that parameter alone is put back to its default, with 95 % intervals."
    axes = Axis("parameter", "category"), Axis("rise of the objective [%]")
    return Chart("What each parameter buys", *axes, [series], note, [Mark(0.0, "no difference")])


def _warnings(searched: Searched, verdict: TuneVerdict) -> list[Warned]:
    warnings = []
    if verdict.broken:
        warnings.append(Warned(f"On runs of other seeds the best point breaks {verdict.broken}.", _NOT_BETTER))
    elif not verdict.improved:
        warnings.append(Warned(f"It is {verdict.sentence}.", _NOT_BETTER))
    if verdict.usual_broken:
        words = f"The defaults break {verdict.usual_broken}."
        warnings.append(Warned(words, "the plan asks for more than they were made for; see its constraints"))
    idle = [parameter.key for parameter in verdict.put_back if parameter.rise.high <= 0.0]
    if idle and verdict.improved:
        words = f"Put back to its default, each of these would be better or the same: {', '.join(idle)}."
        warnings.append(Warned(words, "put them back in config.yaml by hand: fewer changes are easier to trust"))
    broken = sum(bool(point.broken) for point in searched.points)
    if 2 * broken > len(searched.points):
        words = f"{broken} of {len(searched.points)} points broke what has to hold."
        warnings.append(Warned(words, "narrow the ranges in the plan, so that the search does not waste its runs"))
    return warnings


def _told(point: TunePoint) -> str:
    values = ", ".join(f"{key} {_value(value)}" for key, value in point.values.items())
    return f"point {point.number}, objective {number(point.value, 3)}: {values}"
