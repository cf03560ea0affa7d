"""The tables of the comparison."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from diffdrive_mpc.bench.case import DIMENSIONS
from diffdrive_mpc.bench.cells import (
    Cell,
    command_rate,
    completed,
    mean_of,
    recovered,
    recovery_columns,
    share_of,
    total_of,
    worst_of,
)
from diffdrive_mpc.bench.comparison.order import order_table
from diffdrive_mpc.bench.comparison.results import ComparisonResults
from diffdrive_mpc.bench.outcomes import (
    Outcome,
    by,
    by_driver,
    by_horizon,
    by_model,
    disturbed_share,
    drawn_distances,
    mean,
    solve_times,
    step_times,
    time_percentile,
    who_drives,
    with_mean,
)
from diffdrive_mpc.bench.table import Table, number
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.sim.worlds.passage import Passage

Group = Sequence[Outcome]
_PATHS_ON_SCREEN = 4
"""Columns of single paths for which 80 letters have room."""


def _time(of: Callable[[Group], FloatArray], percent: float, digits: int) -> Cell:
    """A percentile of times [ms], with an asterisk where not all of them are undisturbed."""

    def cell(group: Group) -> str:
        times = of(group)
        mark = "*" if times.size and disturbed_share(group) > 0 else ""
        return number(1e3 * time_percentile(times, percent), digits) + mark

    return cell


def _times(percents: Sequence[int] = (50, 99), digits: int = 2) -> dict[str, Cell]:
    """Columns of the solve, then of the whole step."""
    return {
        f"{name} {'max' if percent == 100 else f'p{percent}'} [ms]": _time(of, percent, digits)
        for name, of in (("solve", solve_times), ("step", step_times))
        for percent in percents
    }


_POSITION = {f"position {what} [m]": mean_of(f"position_{what.lower()}_m") for what in ("RMSE", "mean", "std", "max")}
_HEADING = {f"heading {what} [rad]": mean_of(f"heading_{what.lower()}_rad") for what in ("RMSE", "mean", "std", "max")}
_LATERAL = {f"lateral {what} [m]": mean_of(f"lateral_{what.lower()}_m") for what in ("RMSE", "MAE", "p95", "max")}
_IN_BAND = {"in band [%]": mean_of("in_band_percent", partial(number, digits=1))}
_COURSE = {"course RMSE [rad]": mean_of("course_rmse_rad")}
_DRAWN: dict[str, Cell] = {
    "max": lambda group: number(float(drawn_distances(group).max())),
    "rms": lambda group: number(float(np.sqrt(np.mean(drawn_distances(group) ** 2)))),
}
_TRACKING = {
    "position RMSE [m]": mean_of("position_rmse_m"),
    "lateral RMSE [m]": mean_of("lateral_rmse_m"),
    **_COURSE,
}


def report_tables(results: ComparisonResults) -> list[Table]:
    """Every table of a report, in order; those of horizons and scenarios only where there are any."""
    tables = [make(results.main) for make in (summary_table, error_table, path_table, time_table, solver_table)]
    if len(by_driver(results.main)) > 1:
        tables.insert(1, side_by_side_table(results.main))
    if "scenario" not in results.silent:
        tables.append(scenario_table(results.main))
    tables += [horizon_table(results.horizon)] if results.horizon else []
    if len(by_driver(results.main)) > 1:
        tables.append(order_table(results.main, results.other_seeds))
    if results.properties:
        from diffdrive_mpc.bench.comparison.properties import property_table  # noqa: PLC0415 - loads slowly

        tables.append(property_table(results.properties, results.main))
    return tables


def summary_table(outcomes: Group) -> Table:
    """One row for each controller: how well it tracks and what it costs."""
    columns = {**_TRACKING, **_times(), "fallbacks": total_of("fallbacks"), "completed": completed}
    note = (
        "Errors: means over trajectories and seeds; counts over all runs. Solve: linearising, condensing and solving, "
        "or a peer's law; step: all from measurement to command."
    ) + _disturbed_note(outcomes)
    return Table.of("Summary", ("controller",), columns, _by_driver(outcomes), note)


def screen_table(outcomes: Group) -> Table:
    """What the terminal shows of a comparison: a row for each controller, in 80 columns."""
    paths = list(by("trajectory", outcomes))

    def position(path: str) -> Cell:
        return lambda group: number(1e3 * mean(by("trajectory", group).get(path, ()), "position_rmse_m"), 1)

    columns: dict[str, Cell] = {path: position(path) for path in paths} if 1 < len(paths) <= _PATHS_ON_SCREEN else {}
    columns |= {
        "mean": mean_of("position_rmse_m", lambda value: number(1e3 * value, 1)),
        "lateral": mean_of("lateral_rmse_m", lambda value: number(1e3 * value, 1)),
        "p50 [ms]": _time(step_times, 50, 2),
        "p99 [ms]": _time(step_times, 99, 2),
        "completed": completed,
    }
    note = (
        "Position RMSE [mm] by path and as mean over paths and seeds, lateral RMSE to the path; median and 99th "
        "percentile of the whole step."
    ) + _disturbed_note(outcomes)
    return Table.of("Tracking error and step time", ("controller",), columns, _by_driver(outcomes), note)


def side_by_side_table(outcomes: Group) -> Table:
    """Position RMSE, a row for each trajectory and a column for each controller."""
    drivers = {name: by("trajectory", group) for name, group in by_driver(outcomes).items()}
    paths = by("trajectory", outcomes)
    rows = [
        (path, *(number(1e3 * mean(driver.get(path, ()), "position_rmse_m"), 1) for driver in drivers.values()))
        for path in paths
    ]
    means = (number(1e3 * mean(group, "position_rmse_m"), 1) for group in by_driver(outcomes).values())
    rows += [("mean", *means)] if len(paths) > 1 else []
    note = "Position RMSE [mm], means over seeds; of runs that did not complete, up to their end."
    return Table("Path by path", ("trajectory", *drivers), tuple(rows), note=note)


def error_table(outcomes: Group) -> Table:
    """Position and heading errors by trajectory: the statistics of Guffanti et al. 2025, Table 2."""
    note = "Means over seeds. Position: to the reference at the same time. Heading: absolute, wrapped."
    return _by_trajectory("Position and heading error", outcomes, _POSITION | _HEADING, note)


def path_table(outcomes: Group) -> Table:
    """Errors against the path rather than the timed reference, by trajectory."""
    columns = {**_LATERAL, **_COURSE, **_IN_BAND}
    columns |= {"v_ref rate [m/s²]": command_rate("v"), "omega_ref rate [rad/s²]": command_rate("omega")}
    note = (
        "Means over seeds. Lateral: by projection onto the path. Course: direction of travel against its tangent. "
        "Rates: RMS of the change of the command."
    )
    if drawn_distances(outcomes).any():
        columns |= {f"reference to drawn path, {what} [m]": cell for what, cell in _DRAWN.items()}
        note += " The path is that of the reference, which smooth timing lays beside the drawn one."
    if math.isfinite(mean(outcomes, "energy_j")):
        columns |= {"energy [J]": mean_of("energy_j", partial(number, digits=1))}
        note += " Energy: what the battery gives, from the motors' true torques."
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


def world_table(outcomes: Sequence[Outcome]) -> Table:
    """How runs went through their worlds."""

    def cell(write: Callable[[Passage], str]) -> Callable[[Outcome], str]:
        return lambda outcome: "-" if outcome.run.passage is None else write(outcome.run.passage)

    columns: dict[str, Callable[[Outcome], str]] = {
        "arrived": cell(lambda of: "yes" if of.arrived else "no"),
        "time [s]": cell(lambda of: number(of.time_s, 1)),
        "contacts": cell(lambda of: str(of.contacts)),
        "contact speed [m/s]": cell(lambda of: number(of.contact_speed_m_s, 2)),
        "walked into": cell(lambda of: str(of.walked_into)),
        "least clearance [m]": cell(lambda of: number(of.clearance_m, 3)),
        "stood [s]": cell(lambda of: number(of.standing_s, 1)),
    }
    entries = [((one.case.labels["world"], who_drives(one.case)), one) for one in outcomes]
    note = (
        "Contacts: MuJoCo's, of the robot's hull while it moves. Walked into: by persons while it stands. Clearance: "
        "of the hull from anything."
    )
    return Table.of("World", ("world", "controller"), columns, entries, note)


def time_table(outcomes: Group) -> Table:
    """Percentiles of solve and whole step over all ticks of a controller, and which way its solver took."""
    columns: dict[str, Cell] = {
        "horizon": lambda group: " ".join(map(str, by_horizon(group))) or "-",
        "steps": lambda group: str(step_times(group).size),
        **_times((50, 95, 99, 100), 3),
        "deadline misses": total_of("deadline_misses"),
        "undisturbed [%]": lambda group: number(100 * (1 - disturbed_share(group)), 1),
    }
    note = "Over the steps that could be timed undisturbed." + _disturbed_note(outcomes)
    return Table.of("Step time", ("controller",), columns, _by_driver(outcomes), note)


def solver_table(outcomes: Group) -> Table:
    """Which way the solver took, and its iterations."""
    columns: dict[str, Cell] = {
        "unlimited [%]": share_of("path_unlimited_percent"),
        "active set [%]": share_of("path_active_set_percent"),
        "backend [%]": share_of("path_backend_percent"),
        "not solved": lambda group: str(sum(one.shares.not_solved for one in group)),
        "iterations mean": mean_of("iterations_mean", partial(number, digits=2)),
        "iterations max": worst_of("iterations_max", partial(number, digits=0)),
    }
    note = (
        "Shares of solved steps: no limit active, which is one factorisation and no iteration; the active set guessed "
        "and proven; OSQP or DAQP."
    )
    solving = [(name, group) for name, group in _by_driver(outcomes) if math.isfinite(mean(group, "iterations_mean"))]
    return Table.of("Ways of the solver", ("controller",), columns, solving, note)


def horizon_table(outcomes: Group) -> Table:
    """Tracking error and times against the horizon, by model."""
    columns: dict[str, Cell] = {
        "horizon [steps]": lambda group: str(group[0].case.horizon),
        **_TRACKING,
        **_times(),
    }
    entries = [((name,), runs) for name, group in by_model(outcomes).items() for runs in by_horizon(group).values()]
    paths = ", ".join(dict.fromkeys(outcome.case.labels["trajectory"] for outcome in outcomes))
    note = f"Means over {paths}; {_where(outcomes[0])}.{_disturbed_note(outcomes)}"
    return Table.of("Horizon", ("model",), columns, entries, note)


def _disturbed_note(outcomes: Group) -> str:
    """What an asterisk means, where there is one."""
    share = disturbed_share(outcomes)
    if not share:
        return ""
    left_out = all(np.isfinite(one.run.step_time).mean() <= one.clean_share for one in outcomes)
    rest = "and are left out" if left_out else "of one controller none could, so all are kept"
    return f" *: something else ran; {100 * share:.1f} % of the ticks could not be timed undisturbed, {rest}."


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
