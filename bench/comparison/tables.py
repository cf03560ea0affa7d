"""Tables of the comparison, as defined in `tables.yaml`, and functions for their named cells."""

from __future__ import annotations

import math
from functools import cache, partial
from pathlib import Path

import numpy as np
from pandas import DataFrame

from diffdrive_mpc.bench.case import DIMENSIONS, label
from diffdrive_mpc.bench.comparison.order import CERTAINTY, interval, order_table
from diffdrive_mpc.bench.comparison.results import ComparisonResults, best_of, completed_groups
from diffdrive_mpc.bench.experiment import COMPARED, by, mean, values
from diffdrive_mpc.bench.grouped_tables import Cell, TableSpec, cell, grouped_table, load_tables
from diffdrive_mpc.bench.peers import PEERS
from diffdrive_mpc.bench.run_row import model_name
from diffdrive_mpc.bench.table import Table, number
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.pose import ahead_and_left

_PATHS_ON_SCREEN = 4
"""Maximum number of path columns in a terminal of 80 characters."""


@cache
def table_specs() -> dict[str, TableSpec]:
    """Load the tables of `tables.yaml`."""
    return load_tables(Path(__file__).with_name("tables.yaml"))


def step_times(rows: DataFrame) -> FloatArray:
    """Collect the finite step times [s] at counted ticks of all runs."""
    return _times([run.step_time[run.counted] for run in rows["run"]])


def solve_times(rows: DataFrame) -> FloatArray:
    """Collect the finite solve times [s], including linearisation and condensing, at counted ticks of all runs."""
    return _times([run.solve_time[run.counted] for run in rows["run"]])


def _times(parts: list[FloatArray]) -> FloatArray:
    times = np.concatenate(parts)
    return times[np.isfinite(times)]


def time_percentile(times: FloatArray, percent: float) -> float:
    """Compute a percentile of times; NaN if `times` is empty."""
    return float(np.percentile(times, percent)) if times.size else math.nan


def disturbed_share(rows: DataFrame) -> float:
    """Compute the share of ticks of timed runs that have no undisturbed timing; 0 if no run was timed."""
    timed = rows[np.isfinite(values(rows, "clean_share"))]
    ticks = [len(run.time) for run in timed["run"]]
    return float(np.average(1.0 - values(timed, "clean_share"), weights=ticks)) if ticks else 0.0


def _time(name: str, percent: float, digits: int = 2) -> Cell:
    """Format a percentile of times [ms], with an asterisk if some times are disturbed."""

    def time_cell(rows: DataFrame) -> str:
        times = step_times(rows) if name == "step" else solve_times(rows)
        mark = "*" if times.size and disturbed_share(rows) > 0 else ""
        return number(1e3 * time_percentile(times, percent), digits) + mark

    return time_cell


def _recovery_count(rows: DataFrame) -> str:
    """Format the number of recovered runs and of all runs; "-" for a lasting disturbance."""
    times = values(rows, "recovery_time_s")
    return "-" if np.isnan(times).all() else f"{np.count_nonzero(np.isfinite(times))}/{len(rows)}"


CELLS: dict[str, Cell] = {
    "horizons": lambda rows: " ".join(map(str, sorted(rows["horizon"].dropna().astype(int).unique()))) or "-",
    "steps": lambda rows: str(step_times(rows).size),
    "undisturbed": lambda rows: number(100 * (1 - disturbed_share(rows)), 1),
    "recovered": _recovery_count,
    **{f"{name}_p{percent}": _time(name, percent) for name in ("solve", "step") for percent in (50, 99)},
    **{f"{name}_p{percent}_3": _time(name, percent, 3) for name in ("solve", "step") for percent in (50, 95, 99, 100)},
}
"""Cells by their names in `tables.yaml`."""


def report_tables(results: ComparisonResults) -> list[Table]:
    """Build the tables of a report in order; tables without runs are omitted."""
    main, several = results.main, len(by(results.main, COMPARED)) > 1
    tables = [make(main) for make in (summary_table, error_table, path_table, time_table, solver_table)]
    if several:
        tables.insert(1, side_by_side_table(main))
    if "scenario" not in results.silent:
        tables.append(scenario_table(main))
    tables[1:1] = other_robot_tables(results)
    tables += [error_parts_table(main)] if main["seed"].nunique() > 1 else []
    tables += [horizon_table(results.horizon)] if len(results.horizon) else []
    if several:
        tables.append(order_table(main, results.other_seeds))
    return tables


def summary_table(rows: DataFrame) -> Table:
    """Tabulate tracking error and computation time with a row for each controller."""
    return table_specs()["summary"].table(rows, CELLS, _disturbed_note(rows))


def error_table(rows: DataFrame) -> Table:
    """Tabulate position and heading errors by trajectory, with the statistics of Guffanti et al. 2025, Table 2."""
    return table_specs()["errors"].table(rows)


def path_table(rows: DataFrame) -> Table:
    """Tabulate errors relative to the path, instead of the timed reference, by trajectory."""
    spec = table_specs()["path"]
    columns, note = dict(spec.columns), spec.note
    if (rows["drawn_max_m"] > 0.0).any():
        columns |= {
            f"reference to drawn path, {statistic} [m]": f"{name} drawn_{statistic}_m"
            for name, statistic in _DRAWN.items()
        }
        note += " The path is that of the reference; smooth timing and waypoints change it from the drawn path."
    return spec.model_copy(update={"columns": columns, "note": note}).table(rows)


_DRAWN = {"max": "max", "mean": "rms"}


def scenario_table(rows: DataFrame) -> Table:
    """Tabulate the recovery of the controllers from disturbances, by scenario."""
    return table_specs()["scenarios"].table(rows, CELLS)


def other_robot_tables(results: ComparisonResults) -> list[Table]:
    """Return the tables of other robots for which there are runs, see `bench.comparison.other_robots`."""
    parts = {"population": (results.population, ""), "dynamics": (results.dynamics, _advantage_note(results.dynamics))}
    return [table_specs()[name].table(rows, note=note) for name, (rows, note) in parts.items() if len(rows)]


def _advantage_note(rows: DataFrame) -> str:
    """Describe the paired advantage of the best identified model over the best peer on each robot and path."""
    advantages, delays = [], model_name("two_delays")
    for (robot, path), part in rows.groupby(["plant", "trajectory"], sort=False) if len(rows) else ():
        ranked = completed_groups(by(part, "driver"))
        peers = {name: runs for name, runs in ranked.items() if name in PEERS}
        models = {name: runs for name, runs in ranked.items() if name not in peers and name != delays}
        if models and peers:
            best_model, best_peer = best_of(models), best_of(peers)
            before, now = (
                ranked[name].sort_values("seed")["position_rmse_m"].to_numpy() for name in (best_peer, best_model)
            )
            low, high = 100.0 * interval(before - now) / before.mean()
            share = 100.0 * (1.0 - now.mean() / before.mean())
            advantages.append(
                f"{best_model} {share:.0f} % ({low:.0f} to {high:.0f}) ahead of {best_peer} ({label(robot)}, {path})"
            )
    return f" With a paired bootstrap interval of {CERTAINTY:g} %: {'; '.join(advantages)}." if advantages else ""


def error_parts_table(rows: DataFrame) -> Table:
    """Tabulate the parts of the errors along and across the path that are equal for all seeds and that differ."""
    columns = {
        f"{direction} the path, {part} [m]": partial(error_part, component=i, repeats=part == "repeats")
        for i, direction in enumerate(("along", "across"))
        for part in ("repeats", "noise")
    }
    note = "RMS over time, means over trajectories. Repeats: the mean over seeds at each time; noise: the rest."
    return grouped_table("Parts of the error", rows, {"controller": COMPARED}, columns, note)


def error_part(rows: DataFrame, *, component: int, repeats: bool) -> str:
    """Return the RMS [m] of the part of the error that is equal for all seeds, or of the rest.

    `component` is 0 for the error along the reference and 1 for the error across the reference.
    """
    parts = []
    for group in by(rows, "trajectory").values():
        runs = [run for run in group["run"] if not run.ended]
        length = min((int(run.counted.sum()) for run in runs), default=0)
        gaps = [run.true_pose[:length] - run.reference_pose[:length] for run in runs]
        headings = [run.reference_pose[:length, 2] for run in runs]
        errors = np.array([ahead_and_left(*pair)[component] for pair in zip(gaps, headings, strict=True)])
        if len(errors) < 2:
            return "-"
        spread = float(np.mean(np.var(errors, axis=0, ddof=1)))
        square = float(np.mean(errors.mean(axis=0) ** 2)) - spread / len(errors)  # the mean also contains noise
        parts.append(math.sqrt(max(square, 0.0)) if repeats else math.sqrt(spread))
    return number(float(np.mean(parts)), 4)


def time_table(rows: DataFrame) -> Table:
    """Tabulate percentiles of solve and step times over all ticks of a controller."""
    return table_specs()["times"].table(rows, CELLS, _disturbed_note(rows))


def solver_table(rows: DataFrame) -> Table:
    """Tabulate solver methods and iterations of controllers with a solver."""
    solving = [part for part in by(rows, COMPARED).values() if math.isfinite(mean(part, "iterations_mean"))]
    solved = rows[rows.index.isin([index for part in solving for index in part.index])]
    return table_specs()["solver"].table(solved)


def horizon_table(rows: DataFrame) -> Table:
    """Tabulate tracking error and times against the horizon, by model."""
    ordered = rows.sort_values("horizon", kind="stable").astype({"horizon": int})
    note = f"Means over {', '.join(by(rows, 'trajectory'))}; {_where(rows)}.{_disturbed_note(rows)}"
    return table_specs()["horizon"].table(ordered, CELLS, note)


def screen_table(rows: DataFrame) -> Table:
    """Tabulate a comparison for the terminal with a row for each controller, in 80 characters."""
    paths = list(by(rows, "trajectory"))
    error = cell("mean position_rmse_m mm")
    columns = {path: _on_path(path) for path in paths} if 1 < len(paths) <= _PATHS_ON_SCREEN else {}
    columns |= {
        "mean": error,
        "lateral": cell("mean lateral_rmse_m mm"),
        "p50 [ms]": _time("step", 50),
        "p99 [ms]": _time("step", 99),
        "completed": cell("share completed"),
    }
    note = (
        "Position RMSE [mm] by path and as mean over paths and seeds, lateral RMSE to the path; median and 99th "
        "percentile of the whole step."
    ) + _disturbed_note(rows)
    return grouped_table("Tracking error and step time", rows, {"controller": COMPARED}, columns, note)


def side_by_side_table(rows: DataFrame) -> Table:
    """Tabulate position RMSE with a row for each trajectory and a column for each controller."""
    drivers = by(rows, COMPARED)
    cells = {name: _rmse_cell(part) for name, part in drivers.items()}
    note = "Position RMSE [mm], means over seeds; incomplete runs count up to their end."
    return grouped_table("Path by path", rows, {"trajectory": "trajectory"}, cells, note, mean=True)


def _on_path(path: str) -> Cell:
    error = cell("mean position_rmse_m mm")
    return lambda rows: error(rows[rows["trajectory"] == path])


def _rmse_cell(subset: DataFrame) -> Cell:
    """Return a cell for the position RMSE of the rows that are in both a group and `subset`."""
    error = cell("mean position_rmse_m mm")
    return lambda rows: error(rows[rows.index.isin(subset.index)])


def _disturbed_note(rows: DataFrame) -> str:
    """Return the note that explains the asterisk; empty if no tick was disturbed."""
    share = disturbed_share(rows)
    if not share:
        return ""
    finite = np.array([np.isfinite(run.step_time).mean() for run in rows["run"]])
    left_out = not (finite > values(rows, "clean_share")).any()
    rest = "and are omitted" if left_out else "for one controller all ticks, so no ticks are omitted"
    return f" *: some ticks were disturbed; {100 * share:.1f} % could not be timed undisturbed, {rest}."


def _where(rows: DataFrame) -> str:
    """Describe the fixed dimensions of the horizon sweep, of which only the first values are used."""
    case = rows["case"].iloc[0]
    labels = {dimension: case.labels[dimension.name] for dimension in DIMENSIONS if dimension.place}
    parts = [f"{entry.name} {text}" for entry, text in labels.items() if not (entry.silent and text == entry.default)]
    parts += [f"{key}={value}" for key, value in case.overrides if key != "horizon"]
    return ", ".join([*parts, f"seed {case.seed}"])
