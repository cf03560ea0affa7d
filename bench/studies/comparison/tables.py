"""The tables of the comparison."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np

from diffdrive_mpc.bench.case import DIMENSIONS
from diffdrive_mpc.bench.cells import (
    Cell,
    completed,
    mean_of,
    recovered,
    recovery_columns,
    share_of,
    total_of,
    worst_of,
)
from diffdrive_mpc.bench.outcomes import (
    Outcome,
    by,
    by_driver,
    by_horizon,
    by_model,
    drawn_distances,
    step_times,
    with_mean,
)
from diffdrive_mpc.bench.studies.comparison.results import ComparisonResults
from diffdrive_mpc.bench.table import Table, number

Group = Sequence[Outcome]


def _step(percent: float, digits: int = 2) -> Cell:
    return lambda group: number(1e3 * float(np.percentile(step_times(group), percent)), digits)


_POSITION = {f"position {what} [m]": mean_of(f"position_{what.lower()}_m") for what in ("RMSE", "mean", "std", "max")}
_HEADING = {f"heading {what} [rad]": mean_of(f"heading_{what.lower()}_rad") for what in ("RMSE", "mean", "std", "max")}
_LATERAL = {f"lateral {what} [m]": mean_of(f"lateral_{what.lower()}_m") for what in ("RMSE", "MAE", "p95", "max")}
_IN_BAND = {"in band [%]": mean_of("in_band_percent", partial(number, digits=1))}
_DRAWN: dict[str, Cell] = {
    "max": lambda group: number(float(drawn_distances(group).max())),
    "rms": lambda group: number(float(np.sqrt(np.mean(drawn_distances(group) ** 2)))),
}
_STEP = {"step p50 [ms]": _step(50), "step p99 [ms]": _step(99)}
_TRACKING = {
    "position RMSE [m]": mean_of("position_rmse_m"),
    "position max [m]": worst_of("position_max_m"),
    "heading RMSE [rad]": mean_of("heading_rmse_rad"),
}


def report_tables(results: ComparisonResults) -> list[Table]:
    """Every table of a report, in order; those of horizons and scenarios only where there are any."""
    tables = [make(results.main) for make in (summary_table, error_table, path_table, time_table)]
    if "scenario" not in results.silent:
        tables.append(scenario_table(results.main))
    return tables + ([horizon_table(results.horizon)] if results.horizon else [])


def summary_table(outcomes: Group) -> Table:
    """One row for each controller: how well it tracks and what it costs."""
    columns = {
        **_TRACKING,
        "lateral RMSE [m]": mean_of("lateral_rmse_m"),
        **_IN_BAND,
        **_STEP,
        "deadline misses": total_of("deadline_misses"),
        "fallbacks": total_of("fallbacks"),
        "completed": completed,
    }
    note = "Means over trajectories and seeds; maxima and counts over all runs."
    return Table.of("Summary", ("controller",), columns, _by_driver(outcomes), note)


def error_table(outcomes: Group) -> Table:
    """Position and heading errors by trajectory: the statistics of Guffanti et al. 2025, Table 2."""
    note = "Means over seeds. Position: to the reference at the same time. Heading: absolute, wrapped."
    return _by_trajectory("Position and heading error", outcomes, _POSITION | _HEADING, note)


def path_table(outcomes: Group) -> Table:
    """Errors against the path rather than the timed reference, by trajectory."""
    columns = {"course RMSE [rad]": mean_of("course_rmse_rad"), **_LATERAL, **_IN_BAND}
    note = "Means over seeds. Lateral: by projection onto the path. Course: direction of travel against its tangent."
    if drawn_distances(outcomes).any():
        columns |= {f"reference to drawn path, {what} [m]": cell for what, cell in _DRAWN.items()}
        note += " The path is that of the reference, which smooth timing lays beside the drawn one."
    return _by_trajectory("Error against the path", outcomes, columns, note)


def scenario_table(outcomes: Group) -> Table:
    """How the controllers come back from the disturbances, by scenario."""
    names = ("recovery mean [s]", "recovery max [s]", "overshoot max [m]", "lateral max [m]")
    energies = ("v_ref² [m²/s]", "omega_ref² [rad²/s]")
    columns = recovery_columns((*names, *energies)) | {"recovered": recovered, "completed": completed}
    entries = [
        ((scenario, name), group)
        for scenario, runs in by("scenario", outcomes).items()
        for name, group in by_driver(runs).items()
    ]
    note = (
        "Recovery: from the end of the disturbance until the robot stays in the band; -: it lasts; ∞: not back by the "
        "end. Overshoot: beyond the path. v_ref², omega_ref²: integrals, means."
    )
    return Table.of("Scenarios", ("scenario", "controller"), columns, entries, note)


def time_table(outcomes: Group) -> Table:
    """Percentiles of the step time over all ticks of a controller."""
    columns: dict[str, Cell] = {
        "horizon": lambda group: " ".join(map(str, by_horizon(group))) or "-",
        "steps": lambda group: str(step_times(group).size),
        **{f"p{percent} [ms]": _step(percent, 3) for percent in (50, 95, 99)},
        "max [ms]": _step(100, 3),
        "unlimited [%]": share_of("path_unlimited_percent"),
        "active set [%]": share_of("path_active_set_percent"),
        "backend [%]": share_of("path_backend_percent"),
        "not solved": lambda group: str(sum(one.shares.not_solved for one in group)),
    }
    note = (
        "Whole step, serial replay on one core with one BLAS thread. Ways of the solver, in shares of solved steps: "
        "no limit active; the active set guessed and proven; OSQP or DAQP."
    )
    return Table.of("Step time", ("controller",), columns, _by_driver(outcomes), note)


def horizon_table(outcomes: Group) -> Table:
    """Tracking error and step time against the horizon, by model."""
    columns: dict[str, Cell] = {
        "horizon [steps]": lambda group: str(group[0].case.horizon),
        **_TRACKING,
        **_IN_BAND,
        **_STEP,
    }
    entries = [((name,), runs) for name, group in by_model(outcomes).items() for runs in by_horizon(group).values()]
    return Table.of("Horizon", ("model",), columns, entries, f"Means over trajectories; {_where(outcomes[0])}.")


def _where(outcome: Outcome) -> str:
    """Where all runs of the horizon sweep took place: only the first of each dimension is swept."""
    case = outcome.case
    labels = {one: case.labels[one.name] for one in DIMENSIONS if one.place}
    parts = [f"{one.name} {text}" for one, text in labels.items() if not (one.silent and text == one.default)]
    parts += [f"{key}={value}" for key, value in case.overrides if key != "horizon"]
    return ", ".join([*parts, f"seed {case.seed}"])


def _by_driver(outcomes: Group) -> list[tuple[tuple[str, ...], Group]]:
    return [((name,), group) for name, group in by_driver(outcomes).items()]


def _by_trajectory(title: str, outcomes: Group, columns: dict[str, Cell], note: str) -> Table:
    entries = [
        ((name, trajectory), runs)
        for name, group in by_driver(outcomes).items()
        for trajectory, runs in with_mean(by("trajectory", group))
    ]
    return Table.of(title, ("controller", "trajectory"), columns, entries, note)
