"""The tables of a report."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from diffdrive_mpc.bench.case import NO_SCENARIO
from diffdrive_mpc.bench.groups import (
    by_horizon,
    by_model,
    by_scenario,
    by_trajectory,
    groups,
    mean,
    recoveries,
    step_times,
    worst,
)
from diffdrive_mpc.bench.results import Results
from diffdrive_mpc.bench.runner import Outcome
from diffdrive_mpc.bench.table import Table, duration, number
from diffdrive_mpc.models.interface import FloatArray

_POSITION = ("position_rmse_m", "position_mean_m", "position_std_m", "position_max_m")
_HEADING = ("heading_rmse_rad", "heading_mean_rad", "heading_std_rad", "heading_max_rad")
_PATH = ("course_rmse_rad", "lateral_rmse_m", "lateral_mae_m", "lateral_p95_m", "lateral_max_m")


def report_tables(results: Results) -> list[Table]:
    """Every table of a report, in order; those of horizons and scenarios only where there are any."""
    tables = [
        summary_table(results.main),
        error_table(results.main),
        path_table(results.main),
        time_table(results.main),
    ]
    if results.experiment.scenarios != (NO_SCENARIO,):
        tables.append(scenario_table(results.main))
    return tables + ([horizon_table(results.horizon)] if results.horizon else [])


def summary_table(outcomes: Sequence[Outcome]) -> Table:
    """One row for each controller: how well it tracks and what it costs."""
    rows = []
    for name, group in groups(outcomes).items():
        times = step_times(group)
        rows.append(
            (
                name,
                number(mean(group, "position_rmse_m")),
                number(worst(group, "position_max_m")),
                number(mean(group, "heading_rmse_rad")),
                number(mean(group, "lateral_rmse_m")),
                number(mean(group, "in_band_percent"), 1),
                number(1e3 * _percentile(times, 50), 2),
                number(1e3 * _percentile(times, 99), 2),
                str(sum(outcome.run.metrics.deadline_misses for outcome in group)),
                str(sum(outcome.run.metrics.fallbacks for outcome in group)),
                f"{sum(outcome.run.metrics.completed for outcome in group)}/{len(group)}",
            )
        )
    columns = (
        "controller",
        "position RMSE [m]",
        "position max [m]",
        "heading RMSE [rad]",
        "lateral RMSE [m]",
        "in band [%]",
        "step p50 [ms]",
        "step p99 [ms]",
        "deadline misses",
        "fallbacks",
        "completed",
    )
    return Table(
        "Summary", columns, tuple(rows), note="Means over trajectories and seeds; maxima and counts over all runs."
    )


def error_table(outcomes: Sequence[Outcome]) -> Table:
    """Position and heading errors by trajectory: the statistics of Guffanti et al. 2025, Table 2."""
    columns = (
        "controller",
        "trajectory",
        *(f"position {what} [m]" for what in ("RMSE", "mean", "std", "max")),
        *(f"heading {what} [rad]" for what in ("RMSE", "mean", "std", "max")),
    )
    return Table(
        "Position and heading error",
        columns,
        _by_trajectory(outcomes, (*_POSITION, *_HEADING)),
        text_columns=2,
        note="Means over seeds. Position: to the reference at the same time. Heading: absolute, wrapped.",
    )


def path_table(outcomes: Sequence[Outcome]) -> Table:
    """Errors against the path rather than the timed reference, by trajectory."""
    columns = (
        "controller",
        "trajectory",
        "course RMSE [rad]",
        *(f"lateral {what} [m]" for what in ("RMSE", "MAE", "p95", "max")),
        "in band [%]",
    )
    rows = _by_trajectory(outcomes, (*_PATH, "in_band_percent"))
    note = "Means over seeds. Lateral: by projection onto the path. Course: direction of travel against its tangent."
    return Table("Error against the path", columns, rows, text_columns=2, note=note)


def scenario_table(outcomes: Sequence[Outcome]) -> Table:
    """How the controllers come back from the disturbances, by scenario."""
    rows = []
    for scenario, runs in by_scenario(outcomes).items():
        for name, group in groups(runs).items():
            times = recoveries(group, "recovery_time_s")
            rows.append(
                (
                    scenario,
                    name,
                    duration(float(np.mean(times))),
                    duration(float(np.max(times))),
                    number(float(np.max(recoveries(group, "overshoot_m")))),
                    number(worst(group, "lateral_max_m")),
                    number(float(np.mean(recoveries(group, "command_energy_v"))), 2),
                    number(float(np.mean(recoveries(group, "command_energy_omega"))), 2),
                    "-" if np.isnan(times).all() else f"{np.count_nonzero(np.isfinite(times))}/{len(group)}",
                    f"{sum(outcome.run.metrics.completed for outcome in group)}/{len(group)}",
                )
            )
    columns = (
        "scenario",
        "controller",
        "recovery mean [s]",
        "recovery max [s]",
        "overshoot max [m]",
        "lateral max [m]",
        "v_ref² [m²/s]",
        "omega_ref² [rad²/s]",
        "recovered",
        "completed",
    )
    note = (
        "Recovery: from the end of the disturbance until the robot stays in the band; -: it lasts; ∞: not back by the "
        "end. Overshoot: beyond the path. v_ref², omega_ref²: integrals, means."
    )
    return Table("Scenarios", columns, tuple(rows), text_columns=2, note=note)


def time_table(outcomes: Sequence[Outcome]) -> Table:
    """Percentiles of the step time over all ticks of a controller."""
    rows = []
    for name, group in groups(outcomes).items():
        times = step_times(group)
        values = [*(_percentile(times, p) for p in (50, 95, 99)), float(np.max(times))]
        horizons = " ".join(str(steps) for steps in by_horizon(group)) or "-"
        rows.append((name, horizons, str(times.size), *(number(1e3 * value, 3) for value in values)))
    columns = ("controller", "horizon", "steps", "p50 [ms]", "p95 [ms]", "p99 [ms]", "max [ms]")
    return Table("Step time", columns, tuple(rows), note="Whole step, serial replay on one core with one BLAS thread.")


def horizon_table(outcomes: Sequence[Outcome]) -> Table:
    """Tracking error and step time against the horizon, by model."""
    rows = []
    for name, group in by_model(outcomes).items():
        for steps, runs in by_horizon(group).items():
            times = step_times(runs)
            rows.append(
                (
                    name,
                    str(steps),
                    number(mean(runs, "position_rmse_m")),
                    number(worst(runs, "position_max_m")),
                    number(mean(runs, "heading_rmse_rad")),
                    number(mean(runs, "in_band_percent"), 1),
                    number(1e3 * _percentile(times, 50), 2),
                    number(1e3 * _percentile(times, 99), 2),
                )
            )
    columns = (
        "model",
        "horizon [steps]",
        "position RMSE [m]",
        "position max [m]",
        "heading RMSE [rad]",
        "in band [%]",
        "step p50 [ms]",
        "step p99 [ms]",
    )
    return Table("Horizon", columns, tuple(rows), note=f"Means over trajectories; {_place(outcomes[0])}.")


def _place(outcome: Outcome) -> str:
    """Where all runs of the horizon sweep took place: only the first of each dimension is swept."""
    case = outcome.case
    parts = [f"{name} {case.labels[name]}" for name in ("plant", "surface", "sensors")]
    parts += [f"scenario {case.labels['scenario']}"] if case.scenario != NO_SCENARIO else []
    parts += [f"{key}={value}" for key, value in case.overrides if key != "horizon"]
    return ", ".join([*parts, f"seed {case.seed}"])


def _by_trajectory(outcomes: Sequence[Outcome], fields: Sequence[str]) -> tuple[tuple[str, ...], ...]:
    rows = []
    for name, group in groups(outcomes).items():
        parts = list(by_trajectory(group).items())
        if len(parts) > 1:
            parts.append(("mean", group))
        for trajectory, runs in parts:
            digits = [1 if field.endswith("percent") else 4 for field in fields]
            cells = [number(mean(runs, field), d) for field, d in zip(fields, digits, strict=True)]
            rows.append((name, trajectory, *cells))
    return tuple(rows)


def _percentile(values: FloatArray, percent: float) -> float:
    return float(np.percentile(values, percent))
