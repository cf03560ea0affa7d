"""The tables of a tuning, the sentences above them, and the configuration that it gives."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from pathlib import Path

from diffdrive_mpc.app.tune.points import Point, Searched
from diffdrive_mpc.app.tune.tune_file import TunePlan
from diffdrive_mpc.app.tune.verdict import PutBack, Verdict
from diffdrive_mpc.bench.campaign.draws import Value
from diffdrive_mpc.bench.statistics import Estimate
from diffdrive_mpc.bench.table import Table, number
from diffdrive_mpc.models.whole_file import whole_file
from diffdrive_mpc.mpc import ControllerConfig, load_config
from diffdrive_mpc.mpc.config.described import commented_yaml

_LISTED = 12


def facts(plan: TunePlan, searched: Searched, verdict: Verdict) -> list[str]:
    """What came of it, and what was driven for it."""
    through = [sum(one.fidelity > k for one in searched.points) for k in range(len(plan.fidelities))]
    runs = " / ".join(str(one.runs) for one in plan.fidelities)
    broken = [one for one in searched.points if one.broken]
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


def tables(searched: Searched, verdict: Verdict, usual: Mapping[str, Value]) -> list[Table]:
    """All tables of a tuning."""
    made = [_verdict(verdict), _chosen(searched, verdict, usual)]
    if verdict.put_back:
        made.append(_put_back(verdict))
    return [*made, _front(searched)]


def configuration(
    config: str, searched: Searched, verdict: Verdict, plan: TunePlan, usual: Mapping[str, Value], path: Path
) -> None:
    """Write the chosen configuration, or the defaults where it is no better; raises ConfigError if that cannot be.

    Files that it names are named by their path from its folder.
    """
    chosen = searched.best.values if verdict.improved else {}
    other = {key: value for key, value in chosen.items() if value != usual[key]}
    tuned = _beside(load_config(config, other), path.parent)
    worth = {one.key: one for one in verdict.put_back}
    notes = {key: _note(usual[key], worth.get(key)) for key in other}
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


def _points(of: Estimate) -> str:
    """A difference of the objective in percent of that of the defaults, in words."""
    if not math.isfinite(of.value):
        return "unknown"
    return f"{100 * abs(of.value):.1f} % {'higher' if of.value >= 0.0 else 'lower'}"


def _beside(config: ControllerConfig, folder: Path) -> ControllerConfig:
    def named(file: str) -> str:
        return os.path.relpath(file, folder) if Path(file).is_file() else file

    terms = [term.model_copy(update={"file": named(term.file)}) for term in config.terms]
    return config.model_copy(update={"model": named(config.model), "terms": terms})


def _verdict(verdict: Verdict) -> Table:
    rows = [
        (
            f"{one.term.column}, {one.term.figure}",
            f"{100 * one.term.weight:.0f} %",
            f"{one.usual:.4g}",
            f"{one.mine:.4g}",
            _change(one.ratio),
            _interval(one.ratio),
        )
        for one in verdict.figures
    ]
    for name, one in (("error", verdict.error), ("effort", verdict.effort)):
        if math.isfinite(one.value):
            rows.append((name, "", "1", number(one.value, 3), _change(one), _interval(one)))
    gain = verdict.gain
    whole = Estimate(1.0 - gain.value, 1.0 - gain.high, 1.0 - gain.low)
    rows.append(("objective", "", "1", number(whole.value, 3), _change(whole), _interval(whole)))
    return Table(
        "Verdict",
        ("figure", "weight", "defaults", "chosen", "change [%]", "95 % interval [%]"),
        tuple(rows),
        1,
        f"{verdict.runs} runs of each with seeds that the search has not seen, paired run by run; intervals: bootstrap "
        "of 2000 samples. Figures are in the unit of their column; error, effort and objective are weighted ratios.",
    )


def _change(ratio: Estimate) -> str:
    return f"{100 * (ratio.value - 1.0):+.1f}"


def _interval(ratio: Estimate) -> str:
    return f"{100 * (ratio.low - 1.0):+.1f} to {100 * (ratio.high - 1.0):+.1f}"


def _chosen(searched: Searched, verdict: Verdict, usual: Mapping[str, Value]) -> Table:
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


def _put_back(verdict: Verdict) -> Table:
    def cell(of: Estimate) -> str:
        return f"{100 * of.value:+.1f} ({100 * of.low:+.1f} to {100 * of.high:+.1f})"

    rows = tuple(
        (one.key, _value(one.usual), cell(one.rise), cell(one.error), cell(one.effort)) for one in verdict.put_back
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
    rows = [(str(one.number), named.get(one.number, ""), *_score(one)) for one in searched.front[:_LISTED]]
    more = len(searched.front) - len(rows)
    note = "Usable points that no other beats in both error and effort, on the runs of the last fidelity."
    return Table(
        "Error against effort",
        ("point", "", "error", "effort", "objective"),
        tuple(rows),
        2,
        note + (f" {more} more are in tune.json." if more else ""),
    )


def _score(one: Point) -> tuple[str, str, str]:
    return number(one.error, 3), number(one.effort, 3), number(one.value, 3)


def _value(value: Value) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)
