"""The tables of the tracking report. Lengths in millimetres and angles in milliradians: the errors are that small."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from diffdrive_mpc.bench.table import Table, duration, number
from diffdrive_mpc.bench.tracking.results import StudyResults, group, mean
from diffdrive_mpc.bench.tracking.row import Row
from diffdrive_mpc.bench.tracking.variants import BOUND_NAME, variant_names, variants
from diffdrive_mpc.bench.tracking.verdicts import Verdict, judge, not_completed, worst_arc
from diffdrive_mpc.models.load import MODEL_NAMES

_ERRORS = ("position_rmse_m", "lateral_rmse_m", "course_rmse_rad", "heading_rmse_rad")
_ERROR_COLUMNS = ("position RMSE [mm]", "lateral RMSE [mm]", "course RMSE [mrad]", "heading RMSE [mrad]")


def study_tables(results: StudyResults) -> dict[str, list[Table]]:
    """Tables of every part that was run."""
    makers: dict[str, Callable[[StudyResults], list[Table]]] = {
        "targets": lambda r: [target_table(judge(r.parts["targets"], r.study)), default_table(r)],
        "ablation": lambda r: [ablation_table(r), ablation_by_trajectory(r)],
        "cross": lambda r: [cross_table(r)],
        "surfaces": lambda r: [surface_table(r)],
        "scenarios": lambda r: [scenario_table(r)],
        "bound": lambda r: [bound_table(r)],
    }
    return {name: makers[name](results) for name in results.parts}


def target_table(verdicts: Sequence[Verdict]) -> Table:
    """Every target with the value of each model; what is beyond the limit says so."""
    models = list(dict.fromkeys(model for verdict in verdicts for model in verdict.reached))
    rows = []
    for verdict in verdicts:
        cells = [
            _exact(verdict.reached[model]) + ("" if verdict.met_by(model) else " (no)")
            if model in verdict.reached
            else "-"
            for model in models
        ]
        rows.append((verdict.what, verdict.where, _exact(verdict.limit), *cells, "yes" if verdict.met else "no"))
    note = (
        "Means over trajectories and seeds, except what is called worst, largest or longest, which is over all runs, "
        "and counts. The worst arc: mean over seeds of the absolute value, largest over the arcs."
    )
    columns = ("what", "where", "limit", *(_model(model) for model in models), "reached by all")
    return Table("Targets", columns, tuple(rows), text_columns=2, note=note)


def default_table(results: StudyResults) -> Table:
    """The errors on the default surface with the default sensors, by model and trajectory."""
    here = [row for row in results.plain if row.case.surface == "default" and row in results.parts["targets"]]
    rows = []
    for model, theirs in group(here, _model_of).items():
        for trajectory, runs in _with_mean(group(theirs, _trajectory_of), theirs):
            rows.append((_model(model), trajectory, *_errors(runs), _millis(worst_arc(runs))))
    columns = ("model", "trajectory", *_ERROR_COLUMNS, "worst arc [mm]")
    return Table("Default surface and sensors", columns, tuple(rows), text_columns=2, note="Means over seeds.")


def ablation_table(results: StudyResults) -> Table:
    """What each part is worth, by surface and model, with the bound below."""
    rows = []
    for surface, there in group(_ablated(results), _surface_of).items():
        for variant, runs in group(there, lambda row: variants(results.study)[row.case.overrides]).items():
            for model, theirs in group(runs, _model_of).items():
                rows.append((surface, variant, _model(model), *_errors(theirs), _millis(worst_arc(theirs))))
        bound = [row for row in results.parts.get("bound", ()) if row.case.surface == surface]
        if bound:
            rows.append((surface, BOUND_NAME, "-", *_errors(bound), _millis(worst_arc(bound))))
    columns = ("surface", "variant", "model", *_ERROR_COLUMNS, "worst arc [mm]")
    note = f"Means over trajectories and seeds. The {BOUND_NAME} has perfect sensors; see the table of the bound."
    return Table("Ablation", columns, tuple(rows), text_columns=3, note=note)


def ablation_by_trajectory(results: StudyResults) -> Table:
    """Position RMSE by trajectory, over all models of the ablation."""
    trajectories = results.study.trajectories
    rows = []
    for surface, there in group(_ablated(results), _surface_of).items():
        for variant, runs in group(there, lambda row: variants(results.study)[row.case.overrides]).items():
            by = group(runs, _trajectory_of)
            cells = [_millis(mean(by.get(name, ()), "position_rmse_m")) for name in trajectories]
            rows.append((surface, variant, *cells))
    columns = ("surface", "variant", *(f"{name} [mm]" for name in trajectories))
    note = "Position RMSE, means over models and seeds."
    return Table("Ablation by trajectory", columns, tuple(rows), text_columns=2, note=note)


def cross_table(results: StudyResults) -> Table:
    """Position RMSE of a controller of one model on a plant of another."""
    plants = [f"model:{name}" for name in results.study.cross.plants]
    rows = []
    for model, runs in group(results.parts["cross"], _model_of).items():
        by = group(runs, lambda row: row.case.plant)
        own = {plant: "*" if plant == f"model:{model}" else "" for plant in plants}
        rows.append((_model(model), *(_millis(mean(by[plant], "position_rmse_m")) + own[plant] for plant in plants)))
    columns = ("controller", *(f"plant {_model(plant.partition(':')[2])} [mm]" for plant in plants))
    note = "Position RMSE, means over trajectories and seeds. * own prediction model as plant: this proves little."
    return Table("Cross table", columns, tuple(rows), note=note)


def surface_table(results: StudyResults) -> Table:
    """Every surface with every sensor set, by model."""
    rows = []
    for surface, there in group(results.parts["surfaces"], _surface_of).items():
        for sensors, runs in group(there, lambda row: row.case.labels["sensors"]).items():
            for model, theirs in group(runs, _model_of).items():
                lateral = max(row.metrics.lateral_max_m for row in theirs)
                rows.append((surface, sensors, _model(model), *_errors(theirs), _millis(lateral), *_counts(theirs)))
    columns = ("surface", "sensors", "model", *_ERROR_COLUMNS, "lateral max [mm]", "fallbacks", "completed")
    note = "Means over trajectories and seeds; maximum and counts over all runs."
    return Table("Surfaces and sensors", columns, tuple(rows), text_columns=3, note=note)


def scenario_table(results: StudyResults) -> Table:
    """Every disturbance, by model."""
    rows = []
    for scenario, there in group(results.parts["scenarios"], lambda row: row.case.scenario).items():
        for model, runs in group(there, _model_of).items():
            back = [row.recovered for row in runs]
            recovery = [one.recovery_time_s for one in back]
            rows.append(
                (
                    scenario,
                    _model(model),
                    duration(float(np.mean(recovery))),
                    duration(float(np.max(recovery))),
                    _millis(max(one.overshoot_m for one in back)),
                    _millis(max(row.metrics.lateral_max_m for row in runs)),
                    number(float(np.mean([one.command_energy_v for one in back])), 2),
                    number(float(np.mean([one.command_energy_omega for one in back])), 2),
                    *_counts(runs),
                )
            )
    columns = (
        "scenario",
        "model",
        "recovery, mean [s]",
        "longest [s]",
        "overshoot max [mm]",
        "lateral max [mm]",
        "energy v [m^2/s]",
        "energy omega [rad^2/s]",
        "fallbacks",
        "completed",
    )
    note = (
        "Means, maxima and counts over trajectories and seeds. Recovery -: the disturbance lasts to the end; ∞: a run "
        "was not back inside the band by its end."
    )
    return Table("Scenarios", columns, tuple(rows), text_columns=2, note=note)


def bound_table(results: StudyResults) -> Table:
    """The clairvoyant controller beside ours, and what is left."""
    rows = []
    for surface, there in group(results.parts["bound"], _surface_of).items():
        ours = [row for row in results.plain if row.case.surface == surface]
        by = group(ours, _trajectory_of)
        for trajectory, runs in _with_mean(group(there, _trajectory_of), there):
            own = ours if trajectory == "mean" else by.get(trajectory, [])
            reached = mean(own, "position_rmse_m")
            left = reached - mean(runs, "position_rmse_m")
            rows.append((surface, trajectory, *_errors(runs), _millis(reached), _millis(left)))
    columns = ("surface", "trajectory", *_ERROR_COLUMNS, "ours, position [mm]", "left [mm]")
    note = (
        "First figures: the bound, with perfect sensors. Ours: default sensors, mean over models and seeds, all "
        "undisturbed runs of the study. Left: ours minus the bound."
    )
    return Table("Bound", columns, tuple(rows), text_columns=2, note=note)


def _ablated(results: StudyResults) -> list[Row]:
    """Rows of the ablation, surface by surface, in the order of the variants."""
    order = {name: k for k, name in enumerate(variant_names(results.study))}
    names = variants(results.study)
    return sorted(results.parts["ablation"], key=lambda row: order[names[row.case.overrides]])


def _with_mean(groups: dict[str, list[Row]], everything: list[Row]) -> list[tuple[str, list[Row]]]:
    parts = list(groups.items())
    return [*parts, ("mean", everything)] if len(parts) > 1 else parts


def _model_of(row: Row) -> str:
    return row.case.labels["model"]


def _surface_of(row: Row) -> str:
    return row.case.labels["surface"]


def _trajectory_of(row: Row) -> str:
    return row.case.labels["trajectory"]


def _model(name: str) -> str:
    return name.upper() if name in MODEL_NAMES else name


def _errors(rows: Sequence[Row]) -> tuple[str, ...]:
    return tuple(_millis(mean(rows, metric)) for metric in _ERRORS)


def _counts(rows: Sequence[Row]) -> tuple[str, str]:
    return str(sum(row.metrics.fallbacks for row in rows)), f"{len(rows) - int(not_completed(rows))}/{len(rows)}"


def _millis(value: float) -> str:
    return number(1e3 * value, 1)


def _exact(value: float) -> str:
    return f"{value:.3g}" if math.isfinite(value) else "-"
