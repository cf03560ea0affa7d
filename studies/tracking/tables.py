"""The tables of the tracking report. Lengths in millimetres and angles in milliradians: the errors are that small."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

from diffdrive_mpc.bench.cells import Cell, completed, mean_of, millis, recovery_columns, total_of, worst_of
from diffdrive_mpc.bench.outcomes import by, group, mean, model_name, nested, with_mean
from diffdrive_mpc.bench.table import Table
from studies.tracking.outcome import ReducedOutcome, TrackingResults
from studies.tracking.plan import BOUND_NAME, variants
from studies.tracking.verdicts import Verdict, judge, worst_arc

_ERRORS: dict[str, Cell] = {
    "position RMSE [mm]": mean_of("position_rmse_m", millis),
    "lateral RMSE [mm]": mean_of("lateral_rmse_m", millis),
    "course RMSE [mrad]": mean_of("course_rmse_rad", millis),
    "heading RMSE [mrad]": mean_of("heading_rmse_rad", millis),
}
_WORST_ARC: dict[str, Cell] = {"worst arc [mm]": lambda outcomes: millis(worst_arc(outcomes))}
_COUNTS: dict[str, Cell] = {"fallbacks": total_of("fallbacks"), "completed": completed}


def study_tables(results: TrackingResults) -> dict[str, list[Table]]:
    """Tables of every part that was run."""
    makers: dict[str, Callable[[TrackingResults], list[Table]]] = {
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

    def reached(verdict: Verdict, model: str) -> str:
        if model not in verdict.reached:
            return "-"
        return _exact(verdict.reached[model]) + ("" if verdict.met_by(model) else " (no)")

    columns: dict[str, Callable[[Verdict], str]] = {
        "limit": lambda verdict: _exact(verdict.limit),
        **{model_name(model): lambda verdict, model=model: reached(verdict, model) for model in models},  # type: ignore[misc]
        "reached by all": lambda verdict: "yes" if verdict.met else "no",
    }
    note = (
        "Means over trajectories and seeds, except what is called worst, largest or longest, which is over all runs, "
        "and counts. The worst arc: mean over seeds of the absolute value, largest over the arcs."
    )
    entries = [((verdict.what, verdict.where), verdict) for verdict in verdicts]
    return Table.of("Targets", ("what", "where"), columns, entries, note)


def default_table(results: TrackingResults) -> Table:
    """The errors on the default surface with the default sensors, by model and trajectory."""
    here = [one for one in results.plain if one.case.surface == "default" and one in results.parts["targets"]]
    entries = [
        ((*names, trajectory), runs)
        for names, theirs in nested(here, "model")
        for trajectory, runs in with_mean(by("trajectory", theirs))
    ]
    title = "Default surface and sensors"
    return Table.of(title, ("model", "trajectory"), _ERRORS | _WORST_ARC, entries, "Means over seeds.")


def ablation_table(results: TrackingResults) -> Table:
    """What each part is worth, by surface and model, with the bound below."""
    entries: list[tuple[tuple[str, ...], Sequence[ReducedOutcome]]] = []
    for surface, there in _ablated(results).items():
        for variant, runs in there.items():
            entries += [((surface, variant, *names), own) for names, own in nested(runs, "model")]
        bound = [one for one in results.parts.get("bound", ()) if one.case.surface == surface]
        entries += [((surface, BOUND_NAME, "-"), bound)] if bound else []
    note = f"Means over trajectories and seeds. The {BOUND_NAME} has perfect sensors; see the table of the bound."
    return Table.of("Ablation", ("surface", "variant", "model"), _ERRORS | _WORST_ARC, entries, note)


def ablation_by_trajectory(results: TrackingResults) -> Table:
    """Position RMSE by trajectory, over all models of the ablation."""
    columns: dict[str, Cell] = {
        f"{name} [mm]": lambda runs, name=name: millis(mean(by("trajectory", runs).get(name, ()), "position_rmse_m"))  # type: ignore[misc]
        for name in results.study.trajectories
    }
    entries = [
        ((surface, variant), runs) for surface, there in _ablated(results).items() for variant, runs in there.items()
    ]
    note = "Position RMSE, means over models and seeds."
    return Table.of("Ablation by trajectory", ("surface", "variant"), columns, entries, note)


def cross_table(results: TrackingResults) -> Table:
    """Position RMSE of a controller of one model on a plant of another."""

    def cell(runs: Sequence[ReducedOutcome], plant: str) -> str:
        there = by("plant", runs)[f"model:{plant}"]
        return millis(mean(there, "position_rmse_m")) + ("*" if there[0].case.model == plant else "")

    columns: dict[str, Cell] = {
        f"plant {model_name(plant)} [mm]": lambda runs, plant=plant: cell(runs, plant)  # type: ignore[misc]
        for plant in results.study.cross.plants
    }
    note = "Position RMSE, means over trajectories and seeds. * own prediction model as plant: this proves little."
    return Table.of("Cross table", ("controller",), columns, nested(results.parts["cross"], "model"), note)


def surface_table(results: TrackingResults) -> Table:
    """Every surface with every sensor set, by model."""
    columns = {**_ERRORS, "lateral max [mm]": worst_of("lateral_max_m", millis), **_COUNTS}
    note = "Means over trajectories and seeds; maximum and counts over all runs."
    names = ("surface", "sensors", "model")
    return Table.of("Surfaces and sensors", names, columns, nested(results.parts["surfaces"], *names), note)


def scenario_table(results: TrackingResults) -> Table:
    """Every disturbance, by model."""
    names = ("scenario", "model")
    figures = ("recovery, mean [s]", "longest [s]", "overshoot max [mm]", "lateral max [mm]")
    energies = ("energy v [m^2/s]", "energy omega [rad^2/s]")
    note = (
        "Means, maxima and counts over trajectories and seeds. Recovery -: the disturbance lasts to the end; ∞: a run "
        "was not back inside the band by its end."
    )
    columns = recovery_columns((*figures, *energies), millis) | _COUNTS
    return Table.of("Scenarios", names, columns, nested(results.parts["scenarios"], *names), note)


def bound_table(results: TrackingResults) -> Table:
    """The clairvoyant controller beside ours, and what is left."""
    columns: dict[str, Callable[[tuple[Sequence[ReducedOutcome], float]], str]] = {
        name: lambda pair, cell=cell: cell(pair[0])  # type: ignore[misc]
        for name, cell in _ERRORS.items()
    }
    columns["ours, position [mm]"] = lambda pair: millis(pair[1])
    columns["left [mm]"] = lambda pair: millis(pair[1] - mean(pair[0], "position_rmse_m"))
    entries = []
    for surface, there in by("surface", results.parts["bound"]).items():
        ours = [one for one in results.plain if one.case.surface == surface]
        for trajectory, runs in with_mean(by("trajectory", there)):
            own = ours if trajectory == "mean" else by("trajectory", ours).get(trajectory, [])
            entries.append(((surface, trajectory), (runs, mean(own, "position_rmse_m"))))
    note = (
        "First figures: the bound, with perfect sensors. Ours: default sensors, mean over models and seeds, all "
        "undisturbed runs of the study. Left: ours minus the bound."
    )
    return Table.of("Bound", ("surface", "trajectory"), columns, entries, note)


def _ablated(results: TrackingResults) -> dict[str, dict[str, list[ReducedOutcome]]]:
    """Outcomes of the ablation by surface and by variant, in the order of the variants."""
    names = variants(results.study)
    order = list(names)
    outcomes = sorted(results.parts["ablation"], key=lambda one: order.index(one.case.overrides))
    return {
        surface: group(there, lambda one: names[one.case.overrides])
        for surface, there in by("surface", outcomes).items()
    }


def _exact(value: float) -> str:
    return f"{value:.3g}" if math.isfinite(value) else "-"
