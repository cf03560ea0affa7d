"""Run the tracking study for the command line: plan, run, report."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

from diffdrive_mpc.bench.atomic import staged
from diffdrive_mpc.bench.console import output_console
from diffdrive_mpc.bench.machine import describe_run
from diffdrive_mpc.bench.progress import ProgressBar
from diffdrive_mpc.bench.results import STATISTICS
from diffdrive_mpc.bench.runner import available_cores
from diffdrive_mpc.bench.tracking.plan import check_plan, plan_study
from diffdrive_mpc.bench.tracking.report import FIGURES, REPORT_FILES, write_report
from diffdrive_mpc.bench.tracking.results import StudyResults, collect
from diffdrive_mpc.bench.tracking.runner import run_rows
from diffdrive_mpc.bench.tracking.study import PARTS, Study
from diffdrive_mpc.bench.tracking.tables import study_tables


def track(study: Study, out: Path, only: Sequence[str] = PARTS, jobs: int | None = None) -> StudyResults:
    """Run some parts of a study, print the tables and write the report into `out`.

    Parameters
    ----------
    study
        What to run.
    out
        Folder of the report.
    only
        Names of parts.
    jobs
        Processes; by default one for each core.

    Raises
    ------
    models.checked_yaml.ConfigError, ValueError, OSError
        If the study names something that cannot be used or `out` cannot be written to; then `out` keeps what it held.
    """
    began = time.perf_counter()
    plan = plan_study(study, only)
    with staged(out, files=REPORT_FILES, folders=(FIGURES,)) as folder, ProgressBar("preparing") as bar:
        check_plan(plan)
        jobs = jobs or available_cores()
        bar.begin(f"running, {jobs} at a time", len(plan.all))
        rows = run_rows(plan.all, study.trajectories, jobs, bar.advance)
        results = collect(study, plan, rows, _describe(study, only, time.perf_counter() - began))
        write_report(results, folder)
    console = output_console()
    for tables in study_tables(results).values():
        for table in tables:
            console.print(table.rich())
    console.print(f"{len(plan.all)} runs in {time.perf_counter() - began:.0f} s; report in {out}", highlight=False)
    return results


def _describe(study: Study, only: Sequence[str], wall_time: float) -> dict[str, object]:
    return {
        **describe_run(wall_time),
        "statistics": STATISTICS,
        "parts": [part for part in PARTS if part in only],
        "study": study.model_dump(mode="json"),
    }
