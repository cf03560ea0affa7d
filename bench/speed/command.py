"""Run the speed benchmark for the command line."""

from __future__ import annotations

import os
import tempfile
import time
from pathlib import Path

from diffdrive_mpc.bench.atomic import staged
from diffdrive_mpc.bench.console import output_console
from diffdrive_mpc.bench.machine import describe_run
from diffdrive_mpc.bench.progress import ProgressBar
from diffdrive_mpc.bench.speed.measure import load_problem, measure
from diffdrive_mpc.bench.speed.outcome.record import Measured, Missing
from diffdrive_mpc.bench.speed.outcome.report import FIGURES, REPORT_FILES, write_report
from diffdrive_mpc.bench.speed.outcome.results import SpeedResults
from diffdrive_mpc.bench.speed.outcome.tables import speed_tables
from diffdrive_mpc.bench.speed.process.environment import REQUIREMENTS, PeerEnvironment, peer_environment
from diffdrive_mpc.bench.speed.process.subject import SubjectError
from diffdrive_mpc.bench.speed.settings import SpeedSettings


def run_speed(settings: SpeedSettings, out: Path, peer_folder: Path | None = None) -> SpeedResults:
    """Measure, print the tables and write the report into `out`.

    Parameters
    ----------
    settings
        What to run.
    out
        Folder of the report.
    peer_folder
        Where the peers' environment is or will be; by default below the user's cache folder.

    Raises
    ------
    models.checked_yaml.ConfigError, ValueError, OSError
        If the settings name something that cannot be used or `out` cannot be written to; then `out` keeps what it held.
    """
    began, load = time.perf_counter(), os.getloadavg()[0]
    problems = [load_problem(settings, model, n) for model in settings.models for n in settings.horizons]
    core = max(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else None
    measured: list[Measured] = []
    missing: list[Missing] = []
    with staged(out, files=REPORT_FILES, folders=(FIGURES,)) as folder, ProgressBar("preparing the peers") as bar:
        environment = _environment(settings, peer_folder)
        bar.begin("driving", len(problems) * settings.ticks)
        with tempfile.TemporaryDirectory() as scratch:
            for problem in problems:
                place = Path(scratch) / f"{problem.name}-{problem.horizon}"
                found, lost = measure(settings, problem, environment, place, core, bar.advance)
                measured += found
                missing += lost
        if not measured:
            raise ValueError(f"no subject could be run; {missing[0].solver}: {missing[0].reason}")
        meta = {
            **describe_run(time.perf_counter() - began),
            "load": {"before": load, "after": os.getloadavg()[0]},
            "core": core,
            "peers": _pinned(),
            "settings": settings.model_dump(mode="json"),
        }
        results = SpeedResults(tuple(measured), tuple(missing), meta)
        write_report(results, folder)
    console = output_console()
    for table in speed_tables(results):
        console.print(table.rich())
    console.print(f"{len(measured)} records in {time.perf_counter() - began:.0f} s; report in {out}", highlight=False)
    return results


def _environment(settings: SpeedSettings, folder: Path | None) -> PeerEnvironment | SubjectError | None:
    """The peers' environment where it is needed, or why it cannot be had."""
    if not any(subject.foreign for subject in settings.subjects.values()):
        return None
    try:
        return peer_environment(folder)
    except SubjectError as error:
        return error


def _pinned() -> list[str]:
    """The peers and their versions."""
    lines = REQUIREMENTS.read_text(encoding="utf-8").splitlines()
    names = ("comma-deps-acados", "casadi", "do-mpc")
    return [line.replace("==", " ") for line in lines if line.partition("==")[0] in names]
