"""The monitor as a study: every fault on many drives, and hours of drives in which nothing is wrong."""

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
"""First seeds of faulty and of nominal drives: for tuning of the rules, and for reports; earlier ones are used up."""
_TOGETHER = 8


@dataclass(frozen=True)
class MonitorStudyResult:
    """Results of all drives."""

    faulty: dict[str, list[MonitorTrial]]
    nominal: list[MonitorTrial]

    @property
    def hours(self) -> float:
        """Return the hours of nominal driving [h]."""
        return sum(trial.driven for trial in self.nominal) / 3600.0

    @property
    def alarms(self) -> list[MonitorTrial]:
        """Nominal drives that were stopped."""
        return [trial for trial in self.nominal if trial.rule]

    @property
    def false_alarms(self) -> list[MonitorTrial]:
        """Those of drives in which the robot stays near its path and on time without the monitor."""
        return [trial for trial in self.alarms if not trial.left]


class MonitorStudy(Study[list[Task], MonitorStudyResult]):
    """Faults and nominal drives.

    Parameters
    ----------
    rules
        Name or path.
    seeds
        Drives of each fault.
    hours
        Least duration of the nominal drives [h].
    tuning
        Whether to use the seeds that the rules were tuned on.
    """

    name, title = "monitor", "What the monitor catches, and how soon"

    def __init__(self, rules: str, seeds: int, hours: float, *, tuning: bool = False) -> None:
        self._rules, self._seeds, self._hours, self._first = rules, seeds, hours, FIRST_SEED[tuning]

    def plan(self) -> list[Task]:
        """Plan every drive, some per task; raise ConfigError for unknown rules."""
        rules = load_rules(self._rules)
        seeds = range(self._first[0], self._first[0] + self._seeds)
        faulty = [partial(_each, partial(faulty_trial, name), seeds, rules) for name in FAULTS]
        nominal = self._nominal_seeds()
        chunks = (nominal[k : k + _TOGETHER] for k in range(0, len(nominal), _TOGETHER))
        return [*faulty, *(partial(_each, nominal_trial, chunk, rules) for chunk in chunks)]

    def _nominal_seeds(self) -> list[int]:
        """Return as many seeds as the configured driving time needs."""
        left = 3600.0 * self._hours
        nominal: list[int] = []
        for seed in count(self._first[1]):
            if left <= 0.0:
                return nominal
            left -= load_reference(nominal_case(seed)).duration + AFTER
            nominal.append(seed)
        return nominal

    def run(self, plan: list[Task], jobs: int, bar: ProgressBar) -> MonitorStudyResult:
        """Drive them all."""
        bar.start_stage("driving", len(plan))
        done = [trial for trials in run_tasks(plan, jobs, bar.advance) for trial in trials]
        faulty = {name: [trial for trial in done if trial.fault == name] for name in FAULTS}
        return MonitorStudyResult(faulty, [trial for trial in done if not trial.fault])

    def report(self, results: MonitorStudyResult, seconds: float) -> Report:
        """Report a row for each fault, and the nominal drives."""
        rows = [_row(name, held, results.faulty[name]) for name, held in FAULTS.items()]
        columns = ("fault", "of", "stopped by", "stated [s]", "median [s]", "latest [s]", "farthest [m]", "caught")
        note = (
            f"From the fault to the verdict, over {self._seeds} drives each; farthest: true distance from the path"
            f" until the robot stands. Harm is {HARM:g} m, or a robot that commands do not stop (-)."
        )
        table = Table("Faults", columns, tuple(rows), text_columns=3, note=note)
        tables = [table, _nominal_table(results)]
        if results.alarms:
            tables.append(_alarm_table(results.alarms))
        caught = sum(_is_caught(FAULTS[trial.fault], trial) for some in results.faulty.values() for trial in some)
        faulty = sum(map(len, results.faulty.values()))
        facts = [
            f"{len(FAULTS)} faults on {self._seeds} drives each: {caught} of {faulty} caught in time.",
            f"{results.hours:.1f} nominal hours, {len(results.nominal)} drives: {len(results.alarms)} alarms.",
            f"{len(results.false_alarms)} alarms were in drives that stay within {LEFT:g} m of where the reference is.",
            f"Seeds of faults from {self._first[0]} on, of nominal drives from {self._first[1]} on.",
            f"Rules `{self._rules}`, in {seconds:.0f} s.",
        ]
        trials = [*(trial for some in results.faulty.values() for trial in some), *results.nominal]
        content: dict[str, object] = {"trials": [_plain_trial(trial) for trial in trials]}
        meta: dict[str, object] = {"rules": self._rules, "first_seed": self._first}
        return Report(f"{len(trials)} drives", meta, content, facts, tables)


def complaint(results: MonitorStudyResult) -> str:
    """Describe unmet requirements; empty if all are met."""
    late = Counter(
        trial.fault for some in results.faulty.values() for trial in some if not _is_caught(FAULTS[trial.fault], trial)
    )
    missed = ", ".join(f"{name} ({many})" for name, many in late.items())
    alarms = f"{len(results.false_alarms)} nominal drives alarmed" if results.false_alarms else ""
    return "; ".join(filter(None, [f"missed or late: {missed}" if missed else "", alarms]))


def _each(drive: Callable[[int, Rules], MonitorTrial], seeds: Sequence[int], rules: Rules) -> list[MonitorTrial]:
    return [drive(seed, rules) for seed in seeds]


def _is_caught(held: FaultBounds, trial: MonitorTrial) -> bool:
    """Return True if the fault was detected in time, and before harm."""
    in_time = bool(trial.rule) and trial.after <= held.stated
    return in_time and (not held.stoppable or (trial.farthest <= HARM and trial.at_rest))


def _row(name: str, held: FaultBounds, trials: Sequence[MonitorTrial]) -> tuple[str, ...]:
    after = sorted(trial.after if trial.rule else math.inf for trial in trials)
    rules = Counter(trial.rule for trial in trials if trial.rule)
    farthest = max(trial.farthest for trial in trials)
    return (
        name,
        held.part,
        ", ".join(rule.replace("_", " ") for rule, _ in rules.most_common()),
        number(held.stated, 2),
        number(after[len(after) // 2], 2),
        number(after[-1], 2),
        number(farthest, 2) if held.stoppable else "-",
        f"{sum(_is_caught(held, trial) for trial in trials)}/{len(trials)}",
    )


def _nominal_table(results: MonitorStudyResult) -> Table:
    """Tabulate hours and alarms by controller, place and sensors."""
    rows = []
    for name in ("controller", "model", "surface", "scenario", "sensors"):
        for value in sorted({getattr(trial.case, name) for trial in results.nominal}):
            some = [trial for trial in results.nominal if getattr(trial.case, name) == value]
            hours = sum(trial.driven for trial in some) / 3600.0
            farthest = max(trial.farthest for trial in some)
            rows.append(
                (name, value, number(hours, 2), str(sum(bool(trial.rule) for trial in some)), number(farthest, 2))
            )
    columns = ("what", "which", "driven [h]", "alarms", "farthest [m]")
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
