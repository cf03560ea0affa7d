"""Comparison as a study: parallel runs for the motion, followed by serial runs for the step times."""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial

from pandas import DataFrame

from diffdrive_mpc.bench.case import DIMENSIONS, Case
from diffdrive_mpc.bench.comparison.page import page_contents
from diffdrive_mpc.bench.comparison.plan import CasePlan, ComparisonSettings, plan_cases
from diffdrive_mpc.bench.comparison.results import (
    ROW_PARTS,
    TIMING,
    ComparisonResults,
    describe,
    describe_configuration,
    labels_of,
)
from diffdrive_mpc.bench.comparison.tables import other_robot_tables, report_tables, scenario_table, screen_table
from diffdrive_mpc.bench.controllers import run_case
from diffdrive_mpc.bench.experiment import frame
from diffdrive_mpc.bench.progress import ProgressBar
from diffdrive_mpc.bench.run_row import STATISTICS, Row, RunOutcome, row_of
from diffdrive_mpc.bench.runner import run_tasks
from diffdrive_mpc.bench.study import Report, Study
from diffdrive_mpc.bench.timing import TimingPass, time_outcomes


class ComparisonStudy(Study[CasePlan, ComparisonResults]):
    """Comparison of controllers with `settings`."""

    name = "bench"
    title = "Controllers compared: tracking error and step time"

    def __init__(self, settings: ComparisonSettings) -> None:
        self.settings = settings

    def plan(self) -> CasePlan:
        """Plan the cases; raise ConfigError or ValueError if a case cannot be run."""
        return plan_cases(self.settings)

    def cases(self, plan: CasePlan) -> Iterable[Case]:
        """Select the cases whose configuration is checked against the robot."""
        return [case for case in plan.all if case.config is not None]

    def reference_cases(self, plan: CasePlan) -> Iterable[Case]:
        """Return the cases of the tables."""
        return plan.all

    def run(self, plan: CasePlan, jobs: int, bar: ProgressBar) -> ComparisonResults:
        """Run all cases and time the steps of the controllers; raise NotReproducibleError if a replay differs."""
        cases, whole, timed_cases = (*plan.all, *plan.sweep_cases), set(plan.all), plan.timed_cases
        bar.start_stage(f"running, {jobs} at a time", len(cases))
        # Whole runs are stored only for cases of tables and figures.
        outcomes = run_tasks([partial(_drive, case, whole=case in whole) for case in cases], jobs, bar.advance)
        recorded = {run.case: run for run in outcomes if isinstance(run, RunOutcome)}
        bar.start_stage("timing, in turns", len(timed_cases))
        timed, timing = time_outcomes([recorded[case] for case in timed_cases], bar.advance)
        recorded = {case: outcome.without_times for case, outcome in recorded.items()} | {
            run.case: run for run in timed
        }
        rows: dict[Case, Row] = {case: outcome.row for case, outcome in recorded.items()}
        rows |= {run["case"]: run for run in outcomes if not isinstance(run, RunOutcome)}

        def rows_of(part: Iterable[Case]) -> DataFrame:
            return frame(rows[case] for case in part)

        row_parts = {name: rows_of(getattr(plan, name)) for name in ROW_PARTS}
        return ComparisonResults(self.settings, rows_of(plan.main), rows_of(plan.horizon), timing, **row_parts)

    def report(self, results: ComparisonResults, seconds: float) -> Report:
        """Build the report, with overview figures above the tables and the runs of the first seed below."""
        from diffdrive_mpc.bench.comparison.figures import report_figures  # noqa: PLC0415 - matplotlib loads slowly

        named = [
            dimension
            for dimension in DIMENSIONS
            if (dimension.place or dimension.name == "seed") and dimension.name not in results.silent
        ]
        requested = [
            f"{entry.name if entry.place and len(values) == 1 else entry.plural} {', '.join(map(str, values))}"
            for entry in named
            if (values := labels_of(self.settings, entry.plural))
        ]
        chosen = describe_configuration(self.settings)
        return Report(
            size=f"{len(results.all)} runs",
            meta=describe(self.settings, results.timing),
            content=results.content(),
            facts=[
                f"{len(results.all)} runs in {seconds} s; {', '.join(requested)}.",
                *([f"Configuration: {chosen}."] if chosen else []),
            ],
            notes=[
                f"Errors: {STATISTICS}.",
                f"Times: {TIMING}. {_timing_note(results.timing)}",
            ],
            tables=report_tables(results),
            figures=report_figures(results),
            figures_first=3 if len(results.speed) else 1,
            shown=page_contents(results),
            screen=[
                *([scenario_table(results.main)] if "scenario" not in results.silent else []),
                screen_table(results.main),
                *other_robot_tables(results),
            ],
        )


def _drive(case: Case, *, whole: bool) -> RunOutcome | Row:
    run = run_case(case)
    _ = run.errors  # cache the errors in this process, because cases run in parallel
    return RunOutcome(case, run) if whole else row_of(case, run)


def _timing_note(timing: TimingPass) -> str:
    return (
        f"{100 * timing.clean_share:.1f} % of the ticks were undisturbed; other programs used the core for "
        f"{100 * timing.others_share:.1g} % of the time, and the yardstick took {1e6 * timing.yardstick:.1f} us."
    )
