"""What the study keeps of a run beside the usual columns, and the tables of it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from pandas import DataFrame
from studies.worlds.settings import stop_was_possible

from diffdrive_mpc.bench.case import Case
from diffdrive_mpc.bench.experiment import by, total
from diffdrive_mpc.bench.grouped_tables import Cell, load_tables
from diffdrive_mpc.bench.peers import PEERS
from diffdrive_mpc.bench.statistics import BootstrapEstimate, mean, median
from diffdrive_mpc.bench.table import Table, number
from diffdrive_mpc.sim import Run
from diffdrive_mpc_extras.campaign.rates import Rate
from diffdrive_mpc_extras.worlds.plug_in import passage, split, world_record


def measured(case: Case, run: Run) -> dict[str, object]:
    """Columns of a run through a world.

    `stop_possible`: whether a stop before persons who walk was physically possible. `planned_s`: duration of the
    planned path [s]; `arrival_s`: time of a run that arrived [s]; `step_p99_s`: of the controller's step [s].
    """
    passed, name = passage(run), split(case.plant)[1]
    steps = run.step_time[np.isfinite(run.step_time)]
    return {
        "driver": case.controller if case.controller in PEERS else f"mpc, {case.model}",
        "world": name,
        "planned_way": "posts on it" if name.endswith(":through") else "free",
        "collided": passed.contacts > 0,
        "stood_still": not passed.arrived and not passed.contacts,
        "was_walked_into": passed.walked_into > 0,
        "stop_possible": bool(world_record(run).world.movers) and stop_was_possible(case, run) is True,
        "planned_s": run.reference.duration,
        "arrival_s": passed.time_s if passed.arrived else np.nan,
        "last_message": next((message for message in reversed(run.messages) if message), ""),
        "step_p99_s": float(np.percentile(steps, 99)) if steps.size else np.nan,
    }


def rate(rows: DataFrame, column: str) -> Rate:
    """The share of runs for which a column holds, with its interval."""
    return Rate.of_runs(total(rows, column), len(rows))


def lateness(rows: DataFrame) -> BootstrapEstimate:
    """Mean of the time to the goal over that of the planned way, of runs that arrived."""
    arrived = rows[rows["passage_arrived"].astype(bool)]
    return BootstrapEstimate.of_runs((arrived["passage_time_s"] / arrived["planned_s"]).to_numpy(float), mean)


def _median_clearance(rows: DataFrame) -> str:
    arrived = rows[rows["passage_arrived"].astype(bool)]
    return number(BootstrapEstimate.of_runs(arrived["passage_clearance_m"].to_numpy(float), median).value, 3)


def _touched(*, in_time: bool) -> Cell:
    return lambda rows: str(total(rows[rows["stop_possible"] == in_time], "collided"))


CELLS: Mapping[str, Cell] = {
    "arrived_rate": lambda rows: interval(rate(rows, "passage_arrived")),
    "collided_rate": lambda rows: interval(rate(rows, "collided")),
    "stood_rate": lambda rows: interval(
        rate(rows.assign(stood=~(rows["passage_arrived"] | rows["collided"])), "stood")
    ),
    "lateness": lambda rows: estimate(lateness(rows), 2),
    "median_clearance": _median_clearance,
    "touched_in_time": _touched(in_time=True),
    "touched_late": _touched(in_time=False),
}


def study_tables(rows: DataFrame) -> list[Table]:
    """A table for each part that was run."""
    specs, parts = load_tables(Path(__file__).with_name("tables.yaml")), by(rows, "part")
    made = []
    if "drawn" in parts:
        drawn = parts["drawn"].sort_values("planned_way", kind="stable")
        made.append(specs["drawn"].table(drawn, CELLS))
    if "crossing" in parts:
        made.append(specs["crossing"].table(parts["crossing"], CELLS))
    if len(named := rows[rows["part"].isin(("doorway", "named"))]):
        made.append(specs["named"].table(named))
    return [*made, specs["cost"].table(rows)]


def interval(of: Rate) -> str:
    """A rate in percent with its interval."""
    return f"{100 * of.share:.1f} [{100 * of.low:.1f}, {100 * of.high:.1f}]"


def estimate(of: BootstrapEstimate, digits: int) -> str:
    """An estimate with its interval."""
    if not np.isfinite(of.value):
        return "-"
    return f"{of.value:.{digits}f} [{number(of.low, digits)}, {number(of.high, digits)}]"
