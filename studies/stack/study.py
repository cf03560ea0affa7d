"""The study: what is estimated of drawn robots, beside the truth."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from diffdrive_mpc.bench.campaign.rates import Rate
from diffdrive_mpc.bench.progress import ProgressBar
from diffdrive_mpc.bench.runner import run_tasks
from diffdrive_mpc.bench.study import Report, Study
from diffdrive_mpc.bench.table import Table, number
from diffdrive_mpc.models.identification.stack import Quantities, estimate_stack
from diffdrive_mpc.mpc import load_trajectory
from diffdrive_mpc.sim import make_plant
from studies.stack.peers import PeerDrives, all_drives, driven, error_table, identified, parameter_table
from studies.stack.population import drawn_log, load_population

Row = dict[str, object]
FIRST, EVERY = 1000, 2
"""Seeds of the robots: even ones are reserved, and these are of no other study."""
_TUNING = 1


@dataclass(frozen=True)
class StackResults:
    """Rows of the drawn robots, and what is told of the peers' robots with the rows of the drives."""

    rows: list[Row]
    logs: Mapping[str, Quantities]
    drives: list[Row]


def estimated(seed: int) -> list[Row]:
    """A row for each quantity of one robot: truth, value, interval; NaN where it is missing."""
    log, began = drawn_log(seed), time.process_time()
    quantities = estimate_stack(log.data)
    seconds = time.process_time() - began
    rows: list[Row] = []
    for name, truth in log.truth.items():
        quantity = quantities[name]
        low, high = quantity.interval
        value = math.nan if quantity.value is None else quantity.value
        rows.append({"seed": seed, "quantity": name, "truth": truth, "value": value, "low": low, "high": high})
        rows[-1] |= {"reached": log.reached.get(name, True), "seconds": seconds}
    return rows


class StackStudy(Study[list[int], StackResults]):
    """Logs of drawn robots, each estimated from by `estimate_stack` alone; and peers that drive with what a log tells.

    `identify --for` also gives it the limits of the identified model, and with `--effects` that model's effects. Both
    are left out here.

    Parameters
    ----------
    robots
        How many are drawn; 0 for none.
    tuning
        Whether their seeds are those to tune on.
    peers
        What the peers drive; None for nothing.
    """

    name = "stack"
    title = "Parameters for other packages"

    def __init__(self, robots: int, *, tuning: bool = False, peers: PeerDrives | None = None) -> None:
        self._robots, self._tuning, self._peers = robots, tuning, peers

    def plan(self) -> list[int]:
        """The seeds; raises ConfigError or ValueError if a robot or a path of the peers cannot be used."""
        if self._peers is not None:
            for robot in self._peers.robots:
                make_plant(robot)
            for trajectory in self._peers.trajectories:
                load_trajectory(trajectory)
        first = _TUNING if self._tuning else FIRST
        return list(range(first, first + EVERY * self._robots, EVERY))

    def run(self, plan: list[int], jobs: int, bar: ProgressBar) -> StackResults:
        """Estimate from every log, then let the peers drive."""
        bar.begin("estimating", len(plan))
        rows = [
            row for rows in run_tasks([partial(estimated, seed) for seed in plan], jobs, bar.advance) for row in rows
        ]
        peers = self._peers
        if peers is None:
            return StackResults(rows, {}, [])
        bar.begin("estimating for the peers", len(peers.robots))
        estimates = run_tasks([partial(identified, robot, peers) for robot in peers.robots], jobs, bar.advance)
        logs = dict(zip(peers.robots, estimates, strict=True))
        drives = all_drives(peers, logs)
        bar.begin("driving", len(drives))
        return StackResults(rows, logs, run_tasks([partial(driven, drive) for drive in drives], jobs, bar.advance))

    def report(self, results: StackResults, seconds: float) -> Report:
        """How many are estimated, how many intervals hold the truth, and what the parameters do to the peers."""
        seeds = {row["seed"] for row in results.rows}
        facts, tables = [], []
        if seeds:
            facts.append(f"Logs of {len(seeds)} drawn robots with {'tuning' if self._tuning else 'reserved'} seeds.")
            tables.append(coverage_table(results.rows))
        if self._peers is not None:
            facts.append(f"{len(results.drives)} drives of the peers.")
            tables += [error_table(results.drives, self._peers), parameter_table(results.logs)]
        return Report(
            counted=f"{len(seeds)} robots and {len(results.drives)} drives",
            meta={"population": load_population().model_dump(), "peers": self._peers},
            content={"rows": results.rows, "drives": results.drives},
            facts=facts,
            tables=tables,
            notes=[f"{seconds:.0f} s in all."],
        )


def coverage_table(rows: Sequence[Row]) -> Table:
    """One row for each quantity."""
    settings = load_population()
    lines = []
    for name in dict.fromkeys(str(row["quantity"]) for row in rows):
        tolerance = settings.tolerances[name.partition(".")[0]]
        mine = [row for row in rows if row["quantity"] == name]
        there = [row for row in mine if row["reached"]]
        values = np.array([[row[key] for key in ("truth", "value", "low", "high")] for row in there], dtype=float)
        truth, value, low, high = values[np.isfinite(values[:, 1])].T
        error = np.abs(value - truth) / (1.0 if name.startswith("delay") else truth)
        false = sum(not row["reached"] and math.isfinite(float(str(row["value"]))) for row in mine)
        inside, covered = (
            Rate.of_runs(int(np.sum(hits)), len(hits)) if len(hits) else None
            for hits in (error <= tolerance, (low <= truth) & (truth <= high))
        )
        lines.append(
            (
                name,
                f"{len(value)} of {len(there)}",
                f"{false} of {len(mine) - len(there)}",
                f"{tolerance:g}",
                _percent(inside),
                number(float(np.max(error))) if len(error) else "-",
                _percent(covered),
                "-" if covered is None else "yes" if covered.low <= 0.95 <= covered.high else "no",
            )
        )
    columns = (
        "quantity",
        "estimated",
        "estimated falsely",
        "tolerance",
        "within it [%]",
        "largest error",
        "coverage [%]",
        "95 % inside",
    )
    note = "Tolerances and errors: seconds for delays, else relative. Intervals are exact ones (Clopper, Pearson)."
    return Table("What a log tells", columns, tuple(lines), text_columns=len(columns), note=note)


def _percent(rate: Rate | None) -> str:
    return "-" if rate is None else f"{100 * rate.share:.1f} [{100 * rate.low:.1f}, {100 * rate.high:.1f}]"
