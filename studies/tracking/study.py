"""Tracking study: targets, effect of each part of the estimator, and remaining potential for improvement."""

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
    PageContents,
    PageWarning,
    RunViews,
    Series,
    Toggle,
    View,
    round_digits,
)
from diffdrive_mpc.bench.html_report.run_series import HOW_TO_READ, PEAKS
from diffdrive_mpc.bench.spec import Experiment, SpecStudy, load_experiment
from diffdrive_mpc.bench.study import Report
from diffdrive_mpc.bench.table import Table, millis, number
from studies.tracking.measured import BOUND, BOUND_NAME, additional_columns, load_targets, run_or_bound, worst_arc

_FOLDER = Path(__file__).parent
_ADVICE = "docs/results.md explains the limit of each error; the ablation shows the effect of each estimator part"
"""Advice in the warnings about missed targets."""


def load_study(file: Path | None = None, *, quick: bool = False) -> Experiment:
    """Load an experiment, by default the built-in experiment; raise ConfigError if the file is invalid."""
    experiment = load_experiment(file or _FOLDER / ("quick.yaml" if quick else "study.yaml"))
    tables = experiment.tables or load_tables(_FOLDER / "tables.yaml")
    return experiment.model_copy(update={"tables": tables})


@dataclass(frozen=True)
class TargetResult:
    """Target and the values that the models reach.

    Attributes
    ----------
    quantity, where
        Quantity with unit, and description of the runs.
    limit
        Maximum value at which the target is met.
    reached
        Value of each model; NaN if the value could not be computed, so that the target is missed.
    """

    quantity: str
    where: str
    limit: float
    reached: dict[str, float]

    def met_by(self, model: str) -> bool:
        """Return True if the value of `model` does not exceed the limit."""
        return self.reached[model] <= self.limit

    @property
    def met(self) -> bool:
        """True if the values of all models do not exceed the limit."""
        return all(self.met_by(model) for model in self.reached)


def evaluate_targets(rows: DataFrame) -> list[TargetResult]:
    """Evaluate the targets on `rows` of the part "targets"; targets without runs are omitted."""
    results = []
    for target in load_targets().targets:
        selected = rows[np.logical_and.reduce([rows[name] == value for name, value in target.where.items()])]
        value = worst_arc if target.figure == "worst_arc" else figure(target.figure, target.quantity)
        values = {model: value(group) for model, group in by(selected, "driver").items()}
        if values:
            results.append(TargetResult(target.quantity, target.place, target.limit, values))
    return results


def target_table(verdicts: Sequence[TargetResult]) -> Table:
    """Tabulate the targets with the value of each model; "(no)" marks values above the limit."""
    models = list(dict.fromkeys(model for verdict in verdicts for model in verdict.reached))

    def format_value(value: float) -> str:
        return f"{value:.3g}" if np.isfinite(value) else "-"

    def format_cell(verdict: TargetResult, model: str) -> str:
        if model not in verdict.reached:
            return "-"
        return format_value(verdict.reached[model]) + ("" if verdict.met_by(model) else " (no)")

    rows = tuple(
        (
            target.quantity,
            target.where,
            format_value(target.limit),
            *(format_cell(target, model) for model in models),
            "yes" if target.met else "no",
        )
        for target in verdicts
    )
    note = (
        "Means over trajectories and seeds. Counts and quantities named worst, largest or longest are over all runs. "
        "Worst arc: maximum over the arcs of the absolute value, averaged over seeds."
    )
    return Table("Targets", ("what", "where", "limit", *models, "reached by all"), rows, 2, note)


class TrackingStudy(SpecStudy):
    """Study of an experiment with all its parts, or with the parts in `only`."""

    name: ClassVar[str] = "tracking"

    def __init__(self, experiment: Experiment, only: Sequence[str] = ()) -> None:
        trajectories = tuple(map(str, experiment.vary.get("trajectory", ("circle",))))
        super().__init__(experiment, only, additional_columns, partial(run_or_bound, trajectories))

    def tables(self, rows: DataFrame) -> list[Table]:
        """Build the table of targets and the tables of the parts that were run."""
        named_rows = rows.assign(variant=rows["variant"].mask(rows["controller"] == BOUND, BOUND_NAME))
        part = rows[rows["part"] == "targets"]
        targets = [target_table(evaluate_targets(part))] if len(part) else []
        return [*targets, *self.cell_tables(named_rows, _cells(rows))]

    def report(self, results: DataFrame, seconds: float) -> Report:
        """Build the report with the tables and the figures of the parts that were run."""
        from studies.tracking.figures import draw_ablation, draw_error_sources, draw_margin  # noqa: PLC0415

        report = super().report(results, seconds)
        seeds = ", ".join(by(results[results["controller"] != BOUND], "seed"))
        figures = {
            "ablation.png": ("ablation", draw_ablation),
            "error-sources.png": ("ablation", draw_error_sources),
            "margin.png": ("margin", draw_margin),
        }
        parts = set(results["part"])
        return replace(
            report,
            facts=[f"{report.facts[0][:-1]}; seeds {seeds}."],
            figures={name: partial(draw, results) for name, (part, draw) in figures.items() if part in parts},
            shown=page_contents(results),
        )


def _cells(rows: DataFrame) -> Mapping[str, Cell]:
    shipped = rows[rows["plain"].astype(bool)].drop_duplicates("case")

    def our_error(bound: DataFrame) -> float:
        """Compute the error of the shipped controller on the surfaces and trajectories of the bound."""
        matching = shipped[shipped["surface"].isin(bound["surface"]) & shipped["trajectory"].isin(bound["trajectory"])]
        return mean(matching, "position_rmse_m")

    def error_on_plant(group: DataFrame) -> str:
        is_prediction_model = group["plant"].iloc[0] == f"model:{group['model'].iloc[0]}"
        return millis(mean(group, "position_rmse_m")) + ("*" if is_prediction_model else "")

    def floor_error(group: DataFrame, *, error: str = "total", assumed: bool = False) -> str:
        from studies.tracking.floor import position_floor  # noqa: PLC0415 - loads slowly

        combinations = group[["model", "trajectory", "sensors"]].drop_duplicates().itertuples(index=False, name=None)
        floors = [getattr(position_floor(*names, assumed=assumed), error) for names in combinations]
        return number(1e3 * float(np.mean(floors)), 2)

    return {
        "worst_arc": lambda runs: millis(worst_arc(runs)),
        "error_on_plant": error_on_plant,
        "ours": lambda runs: millis(our_error(runs)),
        "floor_total": floor_error,
        "floor_estimate": partial(floor_error, error="estimate"),
        "floor_assumed": partial(floor_error, assumed=True),
        "left": lambda runs: millis(our_error(runs) - mean(runs, "position_rmse_m")),
    }


def page_contents(rows: DataFrame) -> PageContents:
    """Build the content of the page in addition to tables and figures."""
    targets = rows[rows["part"] == "targets"]
    verdicts = evaluate_targets(targets) if len(targets) else []
    unique_rows = rows.drop_duplicates("case")
    rows_with_charts = unique_rows[unique_rows["series"].notna()]
    first = rows_with_charts[rows_with_charts["seed"] == rows_with_charts["seed"].min()]
    models, paths = tuple(by(first, "driver")), tuple(by(first, "trajectory"))
    series = [run.in_style(models.index(name)) for name, run in zip(first["driver"], first["series"], strict=True)]
    runs = [RunViews(series, f"{HOW_TO_READ}. Default surface and sensors, first seed. {PEAKS}.")] if series else []
    views: list[View] = [*runs, *([_target_chart(verdicts, models)] if verdicts else [])]
    met = sum(verdict.met for verdict in verdicts)
    return PageContents(
        summary=[f"{met} of {len(verdicts)} targets are reached by all models."] if verdicts else [],
        key_figures=_key_figures(unique_rows, verdicts, first),
        toggles=[Toggle("model", models, models, styled=True), Toggle("path", paths, paths[:1])] if models else [],
        views=views,
        warnings=_warnings(unique_rows, verdicts),
        configurations=[
            view for group in by(first, "driver").values() for view in configuration(group["case"].iloc[0])
        ],
    )


def _key_figures(rows: DataFrame, verdicts: Sequence[TargetResult], first: DataFrame) -> list[KeyFigure]:
    count = total(rows, "completed")
    figures = [KeyFigure("completed", f"{count} of {len(rows)}", "runs", "good" if count == len(rows) else "bad")]
    if verdicts:
        met = sum(verdict.met for verdict in verdicts)
        status = "good" if met == len(verdicts) else "bad"
        figures.append(KeyFigure("targets reached", f"{met} of {len(verdicts)}", "by all models", status))  # type: ignore[arg-type]
    for name, group in by(first, "driver").items():
        rmse = f"{number(1e3 * mean(group, 'position_rmse_m'), 1)} mm"
        figures.append(KeyFigure(f"position error of {name}, RMSE", rmse, "default surface and sensors"))
    return figures


def _target_chart(verdicts: Sequence[TargetResult], models: Sequence[str]) -> Chart:
    """Build the chart of the values relative to their limits; targets with a limit of zero are omitted."""
    selected = [verdict for verdict in verdicts if verdict.limit > 0]
    names = [f"{entry.quantity.split(' [')[0]}, {entry.where}" for entry in selected]
    series = []
    for model in dict.fromkeys(model for entry in selected for model in entry.reached):
        shares = [round_digits(entry.reached.get(model, np.nan) / entry.limit) for entry in selected]
        style = models.index(model) if model in models else len(models)
        series.append(Series(model, shares, names, style, "rows", labels={"model": model} if model in models else {}))
    axes = Axis("share of the limit"), Axis("", "category")
    note = "A target is reached below 1. Counts with a limit of zero are in the table."
    return Chart("Targets", *axes, series, note, [Mark(1.0, "limit", upright=True)], broad=True, height=560)


def _warnings(rows: DataFrame, verdicts: Sequence[TargetResult]) -> list[PageWarning]:
    warnings = []
    for verdict in verdicts:
        excesses = [f"{model} {value:.3g}" for model, value in verdict.reached.items() if not verdict.met_by(model)]
        if excesses:
            values = f"{', '.join(excesses)} instead of at most {verdict.limit:g}"
            warnings.append(PageWarning(f"Target missed: {verdict.quantity}, {verdict.where}: {values}.", _ADVICE))
    incomplete = rows[~rows["completed"].astype(bool)]
    if len(incomplete):
        names = ("controller", "model", "trajectory", "surface", "scenario")
        where = ", ".join(str(incomplete[name].iloc[0]) for name in names)
        problem = f"{len(incomplete)} runs did not complete, the first: {where}, seed {incomplete['seed'].iloc[0]}."
        warnings.append(
            PageWarning(problem, "run this case alone with `simulate` and these options, and read its report")
        )
    return warnings
