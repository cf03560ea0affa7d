"""The tracking study: what was asked for, what each part of the estimator is worth, and how much is left."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

from diffdrive_mpc.bench.case import Case
from diffdrive_mpc.bench.outcomes import STATISTICS
from diffdrive_mpc.bench.progress import ProgressBar
from diffdrive_mpc.bench.runner import run_tasks
from diffdrive_mpc.bench.study import Report, Study
from studies.tracking.outcome import TrackingResults, collect, is_plain, run_reduced
from studies.tracking.page import shown
from studies.tracking.plan import TrackingPlan, check_plan, plan_study
from studies.tracking.settings import PARTS, TrackingSettings
from studies.tracking.tables import study_tables


class TrackingStudy(Study[TrackingPlan, TrackingResults]):
    """The parts of `settings` that are named in `only`."""

    name = "tracking"
    title = "Tracking"

    def __init__(self, settings: TrackingSettings, only: Sequence[str] = PARTS) -> None:
        self.settings = settings
        self._only = only

    def plan(self) -> TrackingPlan:
        """The cases; raises ConfigError or ValueError if one of them cannot be run."""
        plan = plan_study(self.settings, self._only)
        check_plan(plan)
        return plan

    def run(self, plan: TrackingPlan, jobs: int, bar: ProgressBar) -> TrackingResults:
        """Run every case; each process keeps only what the study needs."""
        bar.begin(f"running, {jobs} at a time", len(plan.all))
        tasks = [
            partial(run_reduced, case, self.settings.trajectories, with_series=self._is_shown(case))
            for case in plan.all
        ]
        return collect(self.settings, plan, run_tasks(tasks, jobs, bar.advance))

    def _is_shown(self, case: Case) -> bool:
        """Whether the page shows a run: of many alike it shows the first seed, on the default floor."""
        return is_plain(case) and case.surface == Case().surface and case.seed == self.settings.targets.seeds[0]

    def report(self, results: TrackingResults, seconds: float) -> Report:
        """Tables of every part that was run; figures only where there was an ablation."""
        from studies.tracking.figures import draw_ablation, draw_error_sources  # noqa: PLC0415

        seeds = ", ".join(map(str, self.settings.targets.seeds))
        drawn = {"ablation.png": draw_ablation, "error-sources.png": draw_error_sources}
        return Report(
            counted=f"{len(results.all)} runs",
            meta={"statistics": STATISTICS, "parts": list(results.parts), "study": self.settings},
            content={"runs": [one.as_json() for one in results.all]},
            facts=[f"{len(results.all)} runs in {seconds} s; targets over seeds {seeds}."],
            notes=[f"Errors: {STATISTICS}."],
            tables=[table for part in study_tables(results).values() for table in part],
            figures={name: partial(draw, results) for name, draw in drawn.items() if "ablation" in results.parts},
            shown=shown(results),
        )
