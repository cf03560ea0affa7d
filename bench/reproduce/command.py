"""Repeat the papers' experiments for the command line: run, print, report."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

from diffdrive_mpc.bench.atomic import staged
from diffdrive_mpc.bench.console import output_console
from diffdrive_mpc.bench.machine import describe_run
from diffdrive_mpc.bench.progress import ProgressBar
from diffdrive_mpc.bench.reproduce.report import FIGURES, REPORT_FILES, write_report
from diffdrive_mpc.bench.reproduce.results import Reproduction
from diffdrive_mpc.bench.reproduce.runner import count_steps, run_parts
from diffdrive_mpc.bench.reproduce.study import PARTS, Study, check_parts
from diffdrive_mpc.bench.reproduce.tables import report_tables
from diffdrive_mpc.bench.runner import available_cores


def repeat(study: Study, out: Path, only: Sequence[str] = PARTS, jobs: int | None = None) -> Reproduction:
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
    check_parts(only)
    with staged(out, files=REPORT_FILES, folders=(FIGURES,)) as folder, ProgressBar("running") as bar:
        bar.begin("running", count_steps(study, only))
        parts = run_parts(study, only, jobs or available_cores(), bar.advance)
        results = Reproduction(study, _describe(only, time.perf_counter() - began), **parts)
        write_report(results, folder)
    console = output_console()
    for table in report_tables(results):
        console.print(table.rich())
    console.print(f"{time.perf_counter() - began:.0f} s; report in {out}", highlight=False)
    return results


def _describe(only: Sequence[str], wall_time: float) -> dict[str, object]:
    return {
        **describe_run(wall_time),
        "parts": [part for part in PARTS if part in only],
    }
