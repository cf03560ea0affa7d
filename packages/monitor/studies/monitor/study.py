"""Study of the monitor: many drives with each fault, and hours of drives without a fault."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import count

from studies.monitor.faults import FAULTS, FaultBounds
from studies.monitor.trial import (
    AFTER,
    HARM,
    LEFT,
    MonitorTrial,
    faulty_trial,
    nominal_case,
    nominal_trial,
)

from diffdrive_mpc.bench.controllers import load_reference
from diffdrive_mpc.bench.plain_values import plain
from diffdrive_mpc.bench.progress import ProgressBar
from diffdrive_mpc.bench.runner import run_tasks
from diffdrive_mpc.bench.study import Report, Study
from diffdrive_mpc.bench.table import Table, number
from diffdrive_mpc_monitor.rules import Rules, load_rules

Task = partial[list[MonitorTrial]]
FIRST_SEED = {True: (0, 0), False: (30_000, 40_000)}
"""First seeds of faulty and of nominal drives, for tuning and for reports; smaller seeds were used before."""
_DRIVES_PER_TASK = 8


@dataclass(frozen=True)
class MonitorStudyResult:
    """Results of all drives."""

    faulty: dict[str, list[MonitorTrial]]
    nominal: list[MonitorTrial]

    @property
    def hours(self) -> float:
        """Duration of the nominal drives [h]."""
        return sum(trial.driven for trial in self.nominal) / 3600.0

    @property
    def alarms(self) -> list[MonitorTrial]:
        """Nominal drives that the monitor stopped."""
        return [trial for trial in self.nominal if trial.rule]

    @property
    def false_alarms(self) -> list[MonitorTrial]:
        """Alarms in drives in which the robot would stay near its path and on time."""
        return [trial for trial in self.alarms if not trial.left]


class MonitorStudy(Study[list[Task], MonitorStudyResult]):
    """Study of faulty and nominal drives.

    Parameters
    ----------
    rules
        Name or path of the rules.
    seeds
        Number of drives for each fault.
    hours
        Minimum duration of the nominal drives [h].
    tuning
        True to use the seeds on which the rules were tuned.
    """

    name, title = "monitor", "Detection rates and times of the monitor"

    def __init__(self, rules: str, seeds: int, hours: float, *, tuning: bool = False) -> None:
        self._rules, self._seeds, self._hours, self._first = rules, seeds, hours, FIRST_SEED[tuning]

    def plan(self) -> list[Task]:
        """Plan the drives as tasks; raises ConfigError for unknown rules."""
        rules = load_rules(self._rules)
        seeds = range(self._first[0], self._first[0] + self._seeds)
        faulty = [partial(_run_seeds, partial(faulty_trial, name), seeds, rules) for name in FAULTS]
        nominal = self._nominal_seeds()
        chunks = (nominal[k : k + _DRIVES_PER_TASK] for k in range(0, len(nominal), _DRIVES_PER_TASK))
        return [*faulty, *(partial(_run_seeds, nominal_trial, chunk, rules) for chunk in chunks)]

    def _nominal_seeds(self) -> list[int]:
        """Return the number of seeds that the configured driving time needs."""
        remaining = 3600.0 * self._hours
        nominal: list[int] = []
        for seed in count(self._first[1]):
            if remaining <= 0.0:
                return nominal
            remaining -= load_reference(nominal_case(seed)).duration + AFTER
            nominal.append(seed)
        return nominal

    def run(self, plan: list[Task], jobs: int, bar: ProgressBar) -> MonitorStudyResult:
        """Simulate all drives."""
        bar.start_stage("driving", len(plan))
        results = [trial for trials in run_tasks(plan, jobs, bar.advance) for trial in trials]
        faulty = {name: [trial for trial in results if trial.fault == name] for name in FAULTS}
        return MonitorStudyResult(faulty, [trial for trial in results if not trial.fault])

    def report(self, results: MonitorStudyResult, seconds: float) -> Report:
        """Return a report with a row for each fault, and tables of the nominal drives."""
        rows = [_row(name, bounds, results.faulty[name]) for name, bounds in FAULTS.items()]
        columns = ("fault", "of", "stopped by", "stated [s]", "median [s]", "latest [s]", "farthest [m]", "caught")
        note = (
            f"Times from the fault to the verdict, {self._seeds} drives each; farthest: true distance from the path"
            f" until the robot stands. Harm is {HARM:g} m, or a robot that commands do not stop (-)."
        )
        table = Table("Faults", columns, tuple(rows), text_columns=3, note=note)
        tables = [table, _nominal_table(results)]
        if results.alarms:
            tables.append(_alarm_table(results.alarms))
        caught = sum(
            _is_caught(FAULTS[trial.fault], trial)
            for trials_of_fault in results.faulty.values()
            for trial in trials_of_fault
        )
        faulty = sum(map(len, results.faulty.values()))
        facts = [
            f"{len(FAULTS)} faults on {self._seeds} drives each: {caught} of {faulty} detected in time.",
            f"{results.hours:.1f} nominal hours, {len(results.nominal)} drives: {len(results.alarms)} alarms.",
            f"{len(results.false_alarms)} alarms are false: their drives stay within {LEFT:g} m of the reference.",
            f"Seeds of faults from {self._first[0]} on, of nominal drives from {self._first[1]} on.",
            f"Rules `{self._rules}`, in {seconds:.0f} s.",
        ]
        trials = [
            *(trial for trials_of_fault in results.faulty.values() for trial in trials_of_fault),
            *results.nominal,
        ]
        content: dict[str, object] = {"trials": [_plain_trial(trial) for trial in trials]}
        meta: dict[str, object] = {"rules": self._rules, "first_seed": self._first}
        return Report(f"{len(trials)} drives", meta, content, facts, tables)


def complaint(results: MonitorStudyResult) -> str:
    """Describe unmet requirements; empty if all are met."""
    late = Counter(
        trial.fault
        for trials_of_fault in results.faulty.values()
        for trial in trials_of_fault
        if not _is_caught(FAULTS[trial.fault], trial)
    )
    missed = ", ".join(f"{name} ({many})" for name, many in late.items())
    alarms = f"{len(results.false_alarms)} nominal drives alarmed" if results.false_alarms else ""
    return "; ".join(filter(None, [f"missed or late: {missed}" if missed else "", alarms]))


def _run_seeds(drive: Callable[[int, Rules], MonitorTrial], seeds: Sequence[int], rules: Rules) -> list[MonitorTrial]:
    return [drive(seed, rules) for seed in seeds]


def _is_caught(bounds: FaultBounds, trial: MonitorTrial) -> bool:
    """Return True if the fault was detected in time and before harm."""
    in_time = bool(trial.rule) and trial.after <= bounds.stated
    return in_time and (not bounds.stoppable or (trial.farthest <= HARM and trial.at_rest))


def _row(name: str, bounds: FaultBounds, trials: Sequence[MonitorTrial]) -> tuple[str, ...]:
    after = sorted(trial.after if trial.rule else math.inf for trial in trials)
    rules = Counter(trial.rule for trial in trials if trial.rule)
    farthest = max(trial.farthest for trial in trials)
    return (
        name,
        bounds.part,
        ", ".join(rule.replace("_", " ") for rule, _ in rules.most_common()),
        number(bounds.stated, 2),
        number(after[len(after) // 2], 2),
        number(after[-1], 2),
        number(farthest, 2) if bounds.stoppable else "-",
        f"{sum(_is_caught(bounds, trial) for trial in trials)}/{len(trials)}",
    )


def _nominal_table(results: MonitorStudyResult) -> Table:
    """Tabulate hours and alarms by controller, environment and sensors."""
    rows = []
    for name in ("controller", "model", "surface", "scenario", "sensors"):
        for value in sorted({getattr(trial.case, name) for trial in results.nominal}):
            trials_of_fault = [trial for trial in results.nominal if getattr(trial.case, name) == value]
            hours = sum(trial.driven for trial in trials_of_fault) / 3600.0
            farthest = max(trial.farthest for trial in trials_of_fault)
            rows.append(
                (
                    name,
                    value,
                    number(hours, 2),
                    str(sum(bool(trial.rule) for trial in trials_of_fault)),
                    number(farthest, 2),
                )
            )
    columns = ("factor", "value", "driven [h]", "alarms", "farthest [m]")
    return Table("Nominal driving", columns, tuple(rows), text_columns=2)


def _alarm_table(alarms: Sequence[MonitorTrial]) -> Table:
    rows = []
    for alarm in alarms:
        case = alarm.case
        drive = f"{case.controller} {case.model}, {case.trajectory}, {case.surface}, {case.scenario}, {case.sensors}"
        rows.append((drive, alarm.words, str(case.seed), number(alarm.after, 2), number(alarm.farthest, 2)))
    return Table("Alarms", ("drive", "words", "seed", "at [s]", "farthest [m]"), tuple(rows), text_columns=2)


def _plain_trial(trial: MonitorTrial) -> dict[str, object]:
    fields = {name: value for name, value in vars(trial).items() if name != "case"}
    return plain(trial.case.as_row() | fields)  # type: ignore[no-any-return]
