"""What the study keeps of a run, and its tables."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields

import numpy as np

from diffdrive_mpc.bench.case import Case
from diffdrive_mpc.bench.cells import Cell, completed, mean_of, millis, time_behind, worst_of
from diffdrive_mpc.bench.controllers import run_case
from diffdrive_mpc.bench.outcomes import SolverShares, count, group, mean, metrics_row, model_name, plain
from diffdrive_mpc.bench.peers import PEERS
from diffdrive_mpc.bench.table import Table, number
from diffdrive_mpc.models.pose import wrap_angle
from diffdrive_mpc.sim import Metrics
from diffdrive_mpc.sim.metrics.recovery import Recovery
from diffdrive_mpc.sim.run import Run

_ACCUSED = re.compile(r"([a-z ]+?) not used: ")
"""A sensor that is not used, in a message of the controller."""
_DIGITS = 6
"""Of every number in `robustness.json`."""
ROOM = 0.05
"""Lateral error [m] up to which a run keeps to its path: the band of Guffanti et al. 2026."""


@dataclass(frozen=True)
class ConditionOutcome:
    """What is kept of a run under a condition; satisfies `bench.outcomes.Scored`.

    Attributes
    ----------
    condition
        Name of the condition.
    case
        What was run.
    metrics, recovery, shares
        Statistics, return after a disturbance, and the ways of the solver.
    late_lateral_m
        Largest |lateral| of the ticks from `settled` on; NaN where there are none.
    heading_nees
        Mean of the squared error of the estimated heading over its variance, about 1 where the estimate knows how good
        it is; NaN for a controller that tells no estimate.
    ended
        Why the robot was lost; empty where it was not.
    message
        What the controller said most often; empty where it said nothing.
    said_percent
        Share of the ticks at which it said anything [%].
    given_up
        How often a sensor was given up: a false alarm where every sensor is honest.
    driven_s
        How long the controller drove or stood [s].
    """

    condition: str
    case: Case
    metrics: Metrics
    recovery: Recovery
    shares: SolverShares
    late_lateral_m: float
    heading_nees: float
    ended: str
    message: str
    said_percent: float
    given_up: int = 0
    driven_s: float = 0.0

    @property
    def driver(self) -> str:
        """The controller as tables write it: a peer's name, or that of the model."""
        return self.case.controller if self.case.controller in PEERS else model_name(self.case.labels["model"])

    def as_json(self) -> dict[str, object]:
        """Labels and numbers as plain values, without step times."""
        own = [field.name for field in fields(self) if field.name not in ("case", "metrics", "recovery", "shares")]
        kept = {k: v for k, v in metrics_row(self).items() if not k.startswith(("step_time", "solve_time", "deadline"))}
        settings = {"set": dict(self.case.overrides)}
        row: dict[str, object] = plain(
            {name: getattr(self, name) for name in own} | self.case.as_row() | settings | kept, _DIGITS
        )
        return row


def run_condition(condition: str, case: Case, settled: float) -> ConditionOutcome:
    """Drive one case and keep what the study shows; lateral errors count from `settled` [s] on."""
    run = run_case(case)
    late = np.abs(run.errors.lateral[run.counted & (run.time >= settled)])
    said = Counter(message for message in run.messages if message)
    return ConditionOutcome(
        condition,
        case,
        run.metrics,
        run.recovery,
        SolverShares.of(run),
        float(np.max(late)) if late.size else float("nan"),
        _heading_nees(run),
        run.ended,
        said.most_common(1)[0][0] if said else "",
        100.0 * said.total() / len(run.messages),
        _given_up(run),
        len(run.modes) * run.sample_time,
    )


def _given_up(run: Run) -> int:
    """How often a sensor began not to be used."""
    count, before = 0, frozenset[str]()
    for message in run.messages:
        now = frozenset(_ACCUSED.findall(message))
        count += len(now - before)
        before = now
    return count


def _heading_nees(run: Run) -> float:
    error, variance = wrap_angle(run.estimates[:, 2] - run.true_pose[:, 2]), run.estimate_deviations[:, 2] ** 2
    known = variance > 0.0
    return float(np.mean(error[known] ** 2 / variance[known])) if known.any() else float("nan")


Rows = Sequence[ConditionOutcome]


def by_condition(rows: Rows) -> dict[str, dict[str, list[ConditionOutcome]]]:
    """Outcomes by condition, and in it by controller, in the order of first appearance."""
    return {
        name: group(theirs, lambda one: one.driver) for name, theirs in group(rows, lambda one: one.condition).items()
    }


def ratios(drivers: Mapping[str, Rows]) -> dict[str, float]:
    """Mean position RMSE of each controller over that of the best one that completed every run; NaN without one."""
    errors = {name: mean(theirs, "position_rmse_m") for name, theirs in drivers.items()}
    arrived = [errors[name] for name, theirs in drivers.items() if all(one.metrics.completed for one in theirs)]
    best = min(arrived, default=float("nan"))
    return {name: error / best for name, error in errors.items()}


def study_tables(rows: Rows) -> list[Table]:
    """Errors under each condition; where there are several controllers, how far each is behind; what they said."""
    conditions = by_condition(rows)
    entries = [((name, driver), runs) for name, drivers in conditions.items() for driver, runs in drivers.items()]
    columns: dict[str, Cell] = {
        "position RMSE [mm]": mean_of("position_rmse_m", millis),
        "largest late lateral [mm]": lambda runs: millis(max(one.late_lateral_m for one in runs)),
        "position max [mm]": worst_of("position_max_m", millis),
        "within 5 cm": lambda runs: f"{sum(one.metrics.lateral_max_m <= ROOM for one in runs)}/{len(runs)}",
        "stops": lambda runs: f"{count(runs, 'stopped')}/{len(runs)}",
        "time behind [s]": time_behind,
        "heading NEES": lambda runs: number(float(np.mean([one.heading_nees for one in runs])), 1),
        "completed": completed,
    }
    note = (
        "Mean RMSE and largest errors over trajectories and seeds; of a run that ended early, of what was driven. "
        "Stops: runs in which it braked on the way, a false stop where every sensor is honest. "
        "Time behind: largest of a run, mean."
    )
    tables = [Table.of("Conditions", ("condition", "controller"), columns, entries, note)]
    if len({driver for _, driver in (names for names, _ in entries)}) > 1:
        tables.append(_ratio_table(conditions))
    return [*tables, _message_table(rows)]


def _ratio_table(conditions: Mapping[str, Mapping[str, Rows]]) -> Table:
    names = list(dict.fromkeys(driver for drivers in conditions.values() for driver in drivers))
    columns: dict[str, Callable[[Mapping[str, float]], str]] = {
        name: lambda row, name=name: number(row.get(name, float("nan")), 2)  # type: ignore[misc]
        for name in names
    }
    entries = [((name,), ratios(drivers)) for name, drivers in conditions.items()]
    note = "Mean position RMSE over that of the best controller that completed every run there."
    return Table.of("Error over the best one's", ("condition",), columns, entries, note)


def _message_table(rows: Rows) -> Table:
    """The most frequent message of the run in which a controller said most."""
    loudest = [
        max(runs, key=lambda one: one.said_percent)
        for drivers in by_condition(rows).values()
        for runs in drivers.values()
    ]
    said = [((one.condition, one.driver, one.ended or one.message), one) for one in loudest if one.ended or one.message]
    columns: dict[str, Callable[[ConditionOutcome], str]] = {"ticks [%]": lambda one: number(one.said_percent, 0)}
    note = "The most frequent message of the run with most of them, and the share of ticks at which anything was said."
    return Table.of("What the controllers said", ("condition", "controller", "message"), columns, said, note)
