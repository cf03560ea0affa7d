"""Study `speed`: step time of the controller, compared with peers on the same problem."""

from __future__ import annotations

import os
import tempfile
from functools import partial
from pathlib import Path

import numpy as np

from diffdrive_mpc.bench.progress import ProgressBar
from diffdrive_mpc.bench.study import Report, Study
from studies.speed.measure import SpeedProblem, load_problem, measure
from studies.speed.process.environment import REQUIREMENTS, PeerEnvironment, peer_environment
from studies.speed.process.subject import SubjectError
from studies.speed.results import Missing, SpeedRecord, SpeedResults, detailed_horizon, speed_tables
from studies.speed.settings import SpeedSettings


class SpeedStudy(Study[list[list[SpeedProblem]], SpeedResults]):
    """Study of step times.

    Parameters
    ----------
    settings
        Settings of the study.
    peer_folder
        Folder of the peers' environment; by default a folder in the user's cache folder.
    """

    name = "speed"
    title = "Step time of the controller and of other solvers of the same problem"

    def __init__(self, settings: SpeedSettings, peer_folder: Path | None = None) -> None:
        self.settings = settings
        self._peer_folder = peer_folder

    def plan(self) -> list[list[SpeedProblem]]:
        """Load a problem for each horizon and model; raise ConfigError or ValueError if a problem is unusable."""
        s = self.settings
        return [[load_problem(s, model, n) for model in s.models] for n in s.horizons]

    def run(self, plan: list[list[SpeedProblem]], jobs: int, bar: ProgressBar) -> SpeedResults:
        """Run all problems on one core; `jobs` is ignored. Raise ValueError if no subject could run."""
        del jobs  # parallel processes would disturb the measurement of times
        load = os.getloadavg()[0]
        core = max(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else None
        records: list[SpeedRecord] = []
        missing: list[Missing] = []
        bar.start_stage("preparing the peers", 1)
        environment = self._environment()
        bar.start_stage("driving", len(plan) * self.settings.ticks)
        with tempfile.TemporaryDirectory() as scratch:
            for problems in plan:
                folder = Path(scratch) / str(problems[0].horizon)
                timed, failed = measure(self.settings, problems, environment, folder, core, bar.advance)
                records += timed
                missing += failed
        if not records:
            raise ValueError(f"no subject could be run; {missing[0].solver}: {missing[0].reason}")
        return SpeedResults(tuple(records), tuple(missing), core, (load, os.getloadavg()[0]))

    def _environment(self) -> PeerEnvironment | SubjectError | None:
        """Return the environment of the peers, None if no subject requires it, or the error if it cannot be created."""
        if not any(subject.needs_environment for subject in self.settings.subjects.values()):
            return None
        try:
            return peer_environment(self._peer_folder)
        except SubjectError as error:
            return error

    def report(self, results: SpeedResults, seconds: float) -> Report:
        """Build the report with the tables and figures of all step times."""
        from studies.speed.figures import draw_horizons, draw_tails  # noqa: PLC0415

        s, (before, after) = self.settings, results.load
        core = "one core for all" if results.core is not None else "not bound to a core"
        missing = "; ".join(dict.fromkeys(f"{entry.solver} ({entry.reason})" for entry in results.missing)) or "none"
        lines = REQUIREMENTS.read_text(encoding="utf-8").splitlines()
        packages = ("comma-deps-acados", "casadi", "do-mpc")
        peers = [line.replace("==", " ") for line in lines if line.partition("==")[0] in packages]
        undisturbed = float(np.mean([record.clean_share for record in results.records]))
        load = {"before": before, "after": after}
        return Report(
            size=f"{len(results.records)} records",
            meta={"load": load, "core": results.core, "peers": peers, "settings": s},
            content=results.as_json(),
            facts=[
                f"{s.ticks} ticks of {s.trajectory}, {s.repetitions} replays in blocks of {s.block} ticks, {core}, one "
                f"BLAS thread, in {seconds} s; {before:.1f} processes ran on the machine before, {after:.1f} after."
            ],
            notes=[
                f"{100 * undisturbed:.1f} % of the steps were not disturbed by other processes or a slower clock. "
                "Disturbed steps are omitted, and medians of rows with disturbed steps are marked *.",
                f"Peers: {', '.join(peers)}. Missing: {missing}.",
            ],
            tables=speed_tables(results),
            figures={
                "horizon.png": partial(draw_horizons, results),
                "tail.png": partial(draw_tails, results, detailed_horizon(results)),
            },
        )
