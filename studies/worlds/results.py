"""What the study keeps of a run beside the usual columns, and the tables of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
from pandas import DataFrame

from diffdrive_mpc.bench.campaign.rates import Rate
from diffdrive_mpc.bench.case import Case
from diffdrive_mpc.bench.experiment import by, total
from diffdrive_mpc.bench.grouped_tables import Cell, grouped_table, load_tables
from diffdrive_mpc.bench.peers import PEERS
from diffdrive_mpc.bench.statistics import BootstrapEstimate, mean, median
from diffdrive_mpc.bench.table import Table, number
from diffdrive_mpc.sim import Run
from studies.worlds.settings import stop_was_possible

_KEPT = 10
"""Every so many ticks the place is kept, for pictures."""
_HARDEST = 12


def measured(case: Case, run: Run) -> dict[str, object]:
    """Columns of a run through a world.

    `stop_possible` says, where persons walk, whether a stop in time was physically possible. `path` (m, 2) are places
    of the robot [m], for pictures. `planned_s` is the duration of the way as it was planned, `arrival_s` that of a run
    that arrived. `step_p99_s` is of the controller's step, `last_message` what it said last.
    """
    passage = run.passage
    assert passage is not None and run.world is not None
    steps = run.step_time[np.isfinite(run.step_time)]
    labels = case.labels
    place = [labels[name] for name in ("plant", "surface", "sensors") if labels[name] not in ("mujoco", "default")]
    return {
        "driver": case.controller if case.controller in PEERS else f"mpc, {case.model}",
        "planned_way": "posts on it" if case.world.endswith(":through") else "free",
        "place": ", ".join(place) or "as tuned",
        "collided": passage.contacts > 0,
        "stood_still": not passage.arrived and not passage.contacts,
        "was_walked_into": passage.walked_into > 0,
        "stop_possible": bool(run.world.movers) and stop_was_possible(case, run) is True,
        "path": run.true_pose[::_KEPT, :2].copy(),
        "planned_s": run.reference.duration,
        "arrival_s": passage.time_s if passage.arrived else np.nan,
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
        made += [specs["drawn"].table(drawn, CELLS), _conditions(drawn)]
    if "crossing" in parts:
        made.append(specs["crossing"].table(parts["crossing"], CELLS))
    if len(named := rows[rows["part"].isin(("doorway", "named"))]):
        made.append(specs["named"].table(named))
    return [*made, _contacts(rows), specs["cost"].table(rows)]


def _conditions(rows: DataFrame) -> Table:
    columns: dict[str, Cell] = {}
    for name in by(rows, "driver"):
        columns[f"{name}: arrived"] = _share_of(name, "passage_arrived")
        columns[f"{name}: collided"] = _share_of(name, "collided")
    note = "Drawn worlds of both kinds."
    return grouped_table("Robots, floors and sensors", rows, {"condition": "place"}, columns, note)


def _share_of(driver: str, column: str) -> Cell:
    def made(rows: DataFrame) -> str:
        own = rows[rows["driver"] == driver]
        return f"{total(own, column)}/{len(own)}"

    return made


def _contacts(rows: DataFrame) -> Table:
    hit = rows[rows["collided"].astype(bool)].sort_values("passage_contact_speed_m_s", ascending=False, kind="stable")
    shown = list(hit.head(_HARDEST).itertuples())
    columns: dict[str, Callable[[object], str]] = {
        "seed": lambda row: str(row.seed),  # type: ignore[attr-defined]
        "speed [m/s]": lambda row: number(row.passage_contact_speed_m_s, 2),  # type: ignore[attr-defined]
    }
    entries = [((one.driver, one.world, one.surface, one.plant, one.ended), one) for one in shown]
    note = f"The hardest {len(shown)} of {len(hit)}."
    return Table.of("Contacts", ("controller", "world", "surface", "plant", "what"), columns, entries, note)


def last_messages(rows: DataFrame, most: int = 3) -> list[str]:
    """What a controller said most often at the end of runs in which it did not arrive."""
    lost = rows[~rows["passage_arrived"].astype(bool) & (rows["last_message"] != "")]
    return [str(message) for message in lost["last_message"].value_counts().head(most).index]


def interval(of: Rate) -> str:
    """A rate in percent with its interval."""
    return f"{100 * of.share:.1f} [{100 * of.low:.1f}, {100 * of.high:.1f}]"


def estimate(of: BootstrapEstimate, digits: int) -> str:
    """An estimate with its interval."""
    if not np.isfinite(of.value):
        return "-"
    return f"{of.value:.{digits}f} [{number(of.low, digits)}, {number(of.high, digits)}]"
