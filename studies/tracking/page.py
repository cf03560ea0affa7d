"""What the page of the tracking study shows: targets, what each part is worth, and errors over time."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from diffdrive_mpc.bench.html_report.configuration import configuration
from diffdrive_mpc.bench.html_report.numbers import rounded
from diffdrive_mpc.bench.html_report.page import Axis, Chart, KeyFigure, Mark, Runs, Series, Shown, Toggle, View, Warned
from diffdrive_mpc.bench.html_report.run_series import HOW_TO_READ, PEAKS
from diffdrive_mpc.bench.outcomes import by, by_model, count, mean, model_name, who_drives
from diffdrive_mpc.bench.table import number
from studies.tracking.outcome import ReducedOutcome, TrackingResults
from studies.tracking.verdicts import Verdict, judge

_MISSED = "docs/tracking.md says what limits each figure; the ablation shows which part of the estimator it hangs on"


def shown(results: TrackingResults) -> Shown:
    """Everything that the page shows beside tables and figures."""
    verdicts = judge(results.parts["targets"], results.study) if "targets" in results.parts else []
    driven = [one for one in results.all if one.series is not None]
    models, paths = tuple(by_model(driven)), tuple(by("trajectory", driven))
    return Shown(
        summary=_sentences(results, verdicts),
        key_figures=_key_figures(results, verdicts, driven),
        toggles=[Toggle("model", models, models, styled=True), Toggle("path", paths, paths[:1])] if driven else [],
        views=[
            *_driven(driven, models),
            *([_targets(verdicts, models)] if verdicts else []),
        ],
        warnings=_warnings(results, verdicts),
        configurations=[one for runs in by_model(driven).values() for one in configuration(runs[0].case)],
    )


def _sentences(results: TrackingResults, verdicts: Sequence[Verdict]) -> list[str]:
    said = [f"Parts: {', '.join(results.parts)}."]
    if not verdicts:
        return said
    met = sum(verdict.met for verdict in verdicts)
    return [f"{met} of {len(verdicts)} targets are reached by all models.", *said]


def _key_figures(
    results: TrackingResults, verdicts: Sequence[Verdict], driven: Sequence[ReducedOutcome]
) -> list[KeyFigure]:
    every = results.all
    done = count(every, "completed")
    made = [KeyFigure("completed", f"{done} of {len(every)}", "runs", "good" if done == len(every) else "bad")]
    if verdicts:
        met = sum(verdict.met for verdict in verdicts)
        sound = "good" if met == len(verdicts) else "bad"
        made.append(KeyFigure("targets reached", f"{met} of {len(verdicts)}", "by all models", sound))  # type: ignore[arg-type]
    for name, runs in by_model(driven).items():
        rmse = f"{number(1e3 * mean(runs, 'position_rmse_m'), 1)} mm"
        made.append(KeyFigure(f"position error of {name}, RMSE", rmse, "default floor and sensors"))
    return made


def _targets(verdicts: Sequence[Verdict], models: Sequence[str]) -> Chart:
    """Each target as share of its limit, where that is not zero."""
    kept = [one for one in verdicts if one.limit > 0]
    names = [f"{one.what.split(' [')[0]}, {one.where}" for one in kept]
    series = []
    for model in dict.fromkeys(model for one in kept for model in one.reached):
        name = model_name(model)
        shares = [rounded(one.reached.get(model, np.nan) / one.limit) for one in kept]
        style = models.index(name) if name in models else len(models)
        series.append(Series(name, shares, names, style, "rows", labels={"model": name} if name in models else {}))
    axes = Axis("share of the limit"), Axis("", "category")
    note = "Below 1 is reached. Counts that must be zero are in the table."
    return Chart("Targets", *axes, series, note, [Mark(1.0, "limit", upright=True)], broad=True, height=560)


def _driven(driven: Sequence[ReducedOutcome], models: Sequence[str]) -> list[View]:
    """The runs whose series were kept, styled by model."""
    if not driven:
        return []
    series = [{**one.series, "style": models.index(who_drives(one.case))} for one in driven if one.series]
    return [Runs(series, f"{HOW_TO_READ}. Default floor and sensors, first seed. {PEAKS}.")]


def _warnings(results: TrackingResults, verdicts: Sequence[Verdict]) -> list[Warned]:
    found = []
    for verdict in verdicts:
        missed = [
            f"{model_name(model)} {value:.3g}" for model, value in verdict.reached.items() if not verdict.met_by(model)
        ]
        if missed:
            asked = f"at most {verdict.limit:g} was asked for, {', '.join(missed)} reached"
            words = f"Target missed: {verdict.what}, {verdict.where}: {asked}."
            found.append(Warned(words, _MISSED))
    lost = [one for one in results.all if not one.metrics.completed]
    if lost:
        labels = lost[0].case.labels
        where = ", ".join(labels[name] for name in ("controller", "model", "trajectory", "surface", "scenario"))
        words = f"{len(lost)} runs did not complete, the first: {where}, seed {labels['seed']}."
        found.append(Warned(words, "drive it alone with `simulate` and these options, and read its report"))
    return found
