"""The tracking study: what was asked for, what each part of the estimator is worth, and how much is left."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import ClassVar

import numpy as np
from pandas import DataFrame

from diffdrive_mpc.bench.experiment import by, mean, total
from diffdrive_mpc.bench.grouped_tables import Cell, figure, load_tables
from diffdrive_mpc.bench.html_report.origin import configuration
from diffdrive_mpc.bench.html_report.page import (
    Axis,
    Chart,
    KeyFigure,
    Mark,
    RunViews,
    Series,
    Shown,
    Toggle,
    View,
    Warned,
    rounded,
)
from diffdrive_mpc.bench.html_report.run_series import HOW_TO_READ, PEAKS
from diffdrive_mpc.bench.spec import Experiment, SpecStudy, load_experiment
from diffdrive_mpc.bench.study import Report
from diffdrive_mpc.bench.table import Table, millis, number
from studies.tracking.measured import BOUND, BOUND_NAME, load_targets, measured, run_or_bound, worst_arc

_FOLDER = Path(__file__).parent
_MISSED = "docs/results.md says what limits each error; the ablation shows which part of the estimator matters"


def load_study(file: Path | None = None, *, quick: bool = False) -> Experiment:
    """Read a study, by default the shipped one; raises ConfigError when the file has a mistake."""
    read = load_experiment(file or _FOLDER / ("quick.yaml" if quick else "study.yaml"))
    return read if read.tables else read.model_copy(update={"tables": load_tables(_FOLDER / "tables.yaml")})


@dataclass(frozen=True)
class TargetResult:
    """One target, and how near each model comes.

    Attributes
    ----------
    what, where
        What is limited, with its unit, and on which runs.
    limit
        Largest value that is allowed.
    reached
        Value of each model; NaN where it could not be computed, which is not within any limit.
    """

    what: str
    where: str
    limit: float
    reached: dict[str, float]

    def met_by(self, model: str) -> bool:
        """Whether `model` stays within the limit."""
        return self.reached[model] <= self.limit

    @property
    def met(self) -> bool:
        """Whether every model does."""
        return all(self.met_by(model) for model in self.reached)


def judge(rows: DataFrame) -> list[TargetResult]:
    """Verdicts on everything that was asked for and driven, from the rows of the part "targets"."""
    verdicts = []
    for target in load_targets().targets:
        there = rows[np.logical_and.reduce([rows[name] == value for name, value in target.where.items()])]
        value = worst_arc if target.figure == "worst_arc" else figure(target.figure, target.what)
        reached = {model: value(own) for model, own in by(there, "driver").items()}
        if reached:
            verdicts.append(TargetResult(target.what, target.at, target.limit, reached))
    return verdicts


def target_table(verdicts: Sequence[TargetResult]) -> Table:
    """Every target with the value of each model; what is beyond the limit says so."""
    models = list(dict.fromkeys(model for verdict in verdicts for model in verdict.reached))

    def exact(value: float) -> str:
        return f"{value:.3g}" if np.isfinite(value) else "-"

    def reached(verdict: TargetResult, model: str) -> str:
        if model not in verdict.reached:
            return "-"
        return exact(verdict.reached[model]) + ("" if verdict.met_by(model) else " (no)")

    rows = tuple(
        (one.what, one.where, exact(one.limit), *(reached(one, model) for model in models), "yes" if one.met else "no")
        for one in verdicts
    )
    note = (
        "Means over trajectories and seeds, except what is called worst, largest or longest, which is over all runs, "
        "and counts. The worst arc: mean over seeds of the absolute value, largest over the arcs."
    )
    return Table("Targets", ("what", "where", "limit", *models, "reached by all"), rows, 2, note)


class TrackingStudy(SpecStudy):
    """An experiment whose parts have the names of those of `study.yaml`, those of `only` or all."""

    name: ClassVar[str] = "tracking"

    def __init__(self, experiment: Experiment, only: Sequence[str] = ()) -> None:
        trajectories = tuple(map(str, experiment.vary.get("trajectory", ("circle",))))
        super().__init__(experiment, only, measured, partial(run_or_bound, trajectories))

    def tables(self, rows: DataFrame) -> list[Table]:
        """Targets first, then every table whose part was driven."""
        shown = rows.assign(variant=rows["variant"].mask(rows["controller"] == BOUND, BOUND_NAME))
        targets = rows[rows["part"] == "targets"]
        return [*([target_table(judge(targets))] if len(targets) else []), *self.stated_tables(shown, _cells(rows))]

    def report(self, results: DataFrame, seconds: float) -> Report:
        """Tables of every part that was run, and figures where their part was."""
        from studies.tracking.figures import draw_ablation, draw_error_sources, draw_margin  # noqa: PLC0415

        plain = super().report(results, seconds)
        seeds = ", ".join(by(results[results["controller"] != BOUND], "seed"))
        drawn = {
            "ablation.png": ("ablation", draw_ablation),
            "error-sources.png": ("ablation", draw_error_sources),
            "margin.png": ("margin", draw_margin),
        }
        driven = set(results["part"])
        return replace(
            plain,
            facts=[f"{plain.facts[0][:-1]}; seeds {seeds}."],
            figures={name: partial(draw, results) for name, (part, draw) in drawn.items() if part in driven},
            shown=shown(results),
        )


def _cells(rows: DataFrame) -> Mapping[str, Cell]:
    ours = rows[rows["plain"].astype(bool)].drop_duplicates("case")

    def ours_there(bound: DataFrame) -> float:
        """Of our controller on the same surface along the same trajectories as rows of the bound."""
        there = ours[ours["surface"].isin(bound["surface"]) & ours["trajectory"].isin(bound["trajectory"])]
        return mean(there, "position_rmse_m")

    def on_plant(own: DataFrame) -> str:
        same = own["plant"].iloc[0] == f"model:{own['model'].iloc[0]}"
        return millis(mean(own, "position_rmse_m")) + ("*" if same else "")

    def on_floor(group: DataFrame, *, error: str = "total", assumed: bool = False) -> str:
        from studies.tracking.floor import position_floor  # noqa: PLC0415 - loads slowly

        places = group[["model", "trajectory", "sensors"]].drop_duplicates().itertuples(index=False, name=None)
        floors = [getattr(position_floor(*place, assumed=assumed), error) for place in places]
        return number(1e3 * float(np.mean(floors)), 2)

    return {
        "worst_arc": lambda own: millis(worst_arc(own)),
        "error_on_plant": on_plant,
        "ours": lambda own: millis(ours_there(own)),
        "floor_total": on_floor,
        "floor_estimate": partial(on_floor, error="estimate"),
        "floor_assumed": partial(on_floor, assumed=True),
        "left": lambda own: millis(ours_there(own) - mean(own, "position_rmse_m")),
    }


def shown(rows: DataFrame) -> Shown:
    """Everything that the page shows beside tables and figures."""
    targets = rows[rows["part"] == "targets"]
    verdicts = judge(targets) if len(targets) else []
    every = rows.drop_duplicates("case")
    kept = every[every["series"].notna()]
    driven = kept[kept["seed"] == kept["seed"].min()]
    models, paths = tuple(by(driven, "driver")), tuple(by(driven, "trajectory"))
    series = [run.in_style(models.index(name)) for name, run in zip(driven["driver"], driven["series"], strict=True)]
    runs = [RunViews(series, f"{HOW_TO_READ}. Default floor and sensors, first seed. {PEAKS}.")] if series else []
    views: list[View] = [*runs, *([_target_chart(verdicts, models)] if verdicts else [])]
    met = sum(verdict.met for verdict in verdicts)
    return Shown(
        summary=[f"{met} of {len(verdicts)} targets are reached by all models."] if verdicts else [],
        key_figures=_key_figures(every, verdicts, driven),
        toggles=[Toggle("model", models, models, styled=True), Toggle("path", paths, paths[:1])] if models else [],
        views=views,
        warnings=_warnings(every, verdicts),
        configurations=[one for own in by(driven, "driver").values() for one in configuration(own["case"].iloc[0])],
    )


def _key_figures(rows: DataFrame, verdicts: Sequence[TargetResult], driven: DataFrame) -> list[KeyFigure]:
    done = total(rows, "completed")
    made = [KeyFigure("completed", f"{done} of {len(rows)}", "runs", "good" if done == len(rows) else "bad")]
    if verdicts:
        met = sum(verdict.met for verdict in verdicts)
        sound = "good" if met == len(verdicts) else "bad"
        made.append(KeyFigure("targets reached", f"{met} of {len(verdicts)}", "by all models", sound))  # type: ignore[arg-type]
    for name, own in by(driven, "driver").items():
        rmse = f"{number(1e3 * mean(own, 'position_rmse_m'), 1)} mm"
        made.append(KeyFigure(f"position error of {name}, RMSE", rmse, "default floor and sensors"))
    return made


def _target_chart(verdicts: Sequence[TargetResult], models: Sequence[str]) -> Chart:
    """Each target as share of its limit, where that is not zero."""
    kept = [verdict for verdict in verdicts if verdict.limit > 0]
    names = [f"{one.what.split(' [')[0]}, {one.where}" for one in kept]
    series = []
    for model in dict.fromkeys(model for one in kept for model in one.reached):
        shares = [rounded(one.reached.get(model, np.nan) / one.limit) for one in kept]
        style = models.index(model) if model in models else len(models)
        series.append(Series(model, shares, names, style, "rows", labels={"model": model} if model in models else {}))
    axes = Axis("share of the limit"), Axis("", "category")
    note = "Below 1 is reached. Counts that must be zero are in the table."
    return Chart("Targets", *axes, series, note, [Mark(1.0, "limit", upright=True)], broad=True, height=560)


def _warnings(rows: DataFrame, verdicts: Sequence[TargetResult]) -> list[Warned]:
    warnings = []
    for verdict in verdicts:
        missed = [f"{model} {value:.3g}" for model, value in verdict.reached.items() if not verdict.met_by(model)]
        if missed:
            asked = f"at most {verdict.limit:g} was asked for, {', '.join(missed)} reached"
            warnings.append(Warned(f"Target missed: {verdict.what}, {verdict.where}: {asked}.", _MISSED))
    lost = rows[~rows["completed"].astype(bool)]
    if len(lost):
        names = ("controller", "model", "trajectory", "surface", "scenario")
        where = ", ".join(str(lost[name].iloc[0]) for name in names)
        words = f"{len(lost)} runs did not complete, the first: {where}, seed {lost['seed'].iloc[0]}."
        warnings.append(Warned(words, "drive it alone with `simulate` and these options, and read its report"))
    return warnings
