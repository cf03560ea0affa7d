"""Study `reproduce`: the papers' experiments on the simulated robot, compared with the published values."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from diffdrive_mpc.bench.plain_values import plain
from diffdrive_mpc.bench.progress import ProgressBar
from diffdrive_mpc.bench.runner import run_tasks
from diffdrive_mpc.bench.study import Draw, Report, Study, check_parts
from diffdrive_mpc.bench.table import Table
from studies.reproduce import cost, drive_models, mbm_and_sm, networks, state_space, virtual_track
from studies.reproduce.published import PARTS, PaperFinding, Published, ReproduceSettings, load_published
from studies.reproduce.virtual_track import DrivenTrack

Result = (
    state_space.SsmResult
    | mbm_and_sm.MbmSmResult
    | networks.NetworkResult
    | networks.NetworkRows
    | drive_models.DriveModelsResult
    | virtual_track.DrivenTrack
)
Task = Callable[[], Result]


@dataclass(frozen=True)
class ReproduceResults:
    """Results by part; a part that was not run is empty or None.

    Attributes
    ----------
    mbm_sm, ssm, lstm
        Results of each repetition.
    rows
        Groups of networks of P1's Table 2.
    cost
        Costs by name of the model.
    virtual_track
        Printed tests and the lines through them.
    drive_models
        Results of each repetition and of each log.
    driven_track
        Results on each surface.
    """

    mbm_sm: tuple[mbm_and_sm.MbmSmResult, ...] = ()
    ssm: tuple[state_space.SsmResult, ...] = ()
    lstm: tuple[networks.NetworkResult, ...] = ()
    rows: tuple[networks.NetworkRows, ...] = ()
    cost: Mapping[str, cost.Cost] | None = None
    virtual_track: virtual_track.VirtualTrackResult | None = None
    drive_models: tuple[drive_models.DriveModelsResult, ...] = ()
    driven_track: tuple[DrivenTrack, ...] = ()


class ReproduceStudy(Study[list[Task], ReproduceResults]):
    """Study of the parts `only`; `data` is the folder of the logs of real robots, or None to skip these logs."""

    name = "reproduce"
    title = "The papers repeated"

    def __init__(self, settings: ReproduceSettings, only: Sequence[str] = PARTS, data: Path | None = None) -> None:
        self.settings = settings
        self._only = only
        self._data = data

    def plan(self) -> list[Task]:
        """Plan the tasks; the longest are first, because a long task at the end leaves cores idle."""
        check_parts(self._only, PARTS)
        s, only = self.settings, self._only
        tasks: list[Task] = []
        if "lstm" in only:
            published, repetition = load_published().networks, s.repetitions[0]
            for rows in s.lstm.rows:
                tasks.append(partial(networks.train_rows, s.lstm, {row: published[row] for row in rows}, repetition))
            tasks += [partial(networks.compare_with_ssm, s.lstm, k) for k in s.repetitions]
        tasks += [partial(state_space.compare_orders, s.ssm, k) for k in s.repetitions if "ssm" in only]
        if "drive_models" in only:
            if self._data:
                tasks += [partial(drive_models.compare_on_log, name, self._data) for name in s.drive_models.logs]
            tasks += [
                partial(drive_models.compare_on_twin, s.drive_models, k)
                for k in s.repetitions[: s.drive_models.repetitions]
            ]
        if "virtual_track" in only:
            tasks += [
                partial(virtual_track.drive_tests, s.driven_track, surface) for surface in s.driven_track.surfaces
            ]
        return tasks + [partial(mbm_and_sm.compare_mbm_and_sm, s.mbm_sm, k) for k in s.repetitions if "mbm_sm" in only]

    def run(self, plan: list[Task], jobs: int, bar: ProgressBar) -> ReproduceResults:
        """Run all repetitions in several processes; then measure the costs, while no other process runs."""
        runs_cost = "cost" in self._only
        bar.start_stage("running", len(plan) + 2 * self.settings.cost.runs * runs_cost)
        results = run_tasks(plan, jobs, bar.advance)
        drive_results = sorted(
            (result for result in results if isinstance(result, drive_models.DriveModelsResult)),
            key=lambda result: -result.repetition,
        )
        runs_virtual_track, published = "virtual_track" in self._only, load_published()
        rules = published.rules
        return ReproduceResults(
            ssm=tuple(result for result in results if isinstance(result, state_space.SsmResult)),
            mbm_sm=tuple(result for result in results if isinstance(result, mbm_and_sm.MbmSmResult)),
            lstm=tuple(result for result in results if isinstance(result, networks.NetworkResult)),
            rows=tuple(result for result in results if isinstance(result, networks.NetworkRows)),
            drive_models=tuple(drive_results),
            driven_track=tuple(result for result in results if isinstance(result, virtual_track.DrivenTrack)),
            cost=cost.measure_cost(self.settings.cost, bar.advance) if runs_cost else None,
            virtual_track=virtual_track.check_virtual_track(published.virtual_track, rules.agreement_deviations)
            if runs_virtual_track
            else None,
        )

    def report(self, results: ReproduceResults, seconds: float) -> Report:
        """Build the report: findings with verdicts, and all results without the curves of paths and responses."""
        parts = [part for part in PARTS if getattr(results, part)]
        content = plain(results)
        for result in [*content["mbm_sm"], *content["lstm"]]:
            for name in ("paths", "responses", "motions"):
                result.pop(name, None)
        findings = evaluate_findings(results)
        repetitions = ", ".join(map(str, self.settings.repetitions))
        setup = f"plant mujoco, surface default, sensors default, repetitions {repetitions}"
        return Report(
            size="one part" if len(parts) == 1 else f"{len(parts)} parts",
            meta={"parts": parts},
            content={
                "findings": [plain(finding) | {"verdict": finding.verdict} for finding in findings],
                "study": self.settings,
                **content,
            },
            facts=[f"Parts {', '.join(parts)} in {seconds} s; {setup}."],
            tables=report_tables(results, findings_table(findings, len(self.settings.repetitions))),
            figures=_figures(results),
        )


def report_tables(results: ReproduceResults, findings: Table) -> list[Table]:
    """Build the tables of the parts that were run, starting with the findings."""
    published = load_published()
    rows = [row for rows in results.rows for row in rows.rows]
    parts: list[tuple[Any, Callable[[Any, Published], list[Table]]]] = [
        (results.mbm_sm, mbm_and_sm.mbm_sm_tables),
        (results.ssm, state_space.ssm_tables),
        (rows, lambda part, published: [networks.row_table(part, published)]),
        (results.lstm, networks.free_drive_tables),
        (results.cost, lambda part, published: [cost.cost_table(part, published)]),
        (results.virtual_track, lambda part, _: [virtual_track.virtual_track_table(part)]),
        (results.driven_track, virtual_track.driven_track_tables),
        (results.drive_models, drive_models.drive_model_tables),
    ]
    return [findings, *(table for part, tables in parts if part for table in tables(part, published))]


def _figures(results: ReproduceResults) -> dict[str, Draw]:
    """Return functions that draw the figures of the parts that were run, by file name."""
    from studies.reproduce import figures  # noqa: PLC0415 - matplotlib loads slowly

    parts: dict[str, tuple[Any, Callable[[Any, Path], None]]] = {
        "odometry.png": (results.mbm_sm, figures.draw_odometry),
        "error-maps.png": (results.mbm_sm, figures.draw_error_maps),
        "responses.png": (results.mbm_sm, figures.draw_responses),
        "orders.png": (results.ssm, figures.draw_orders),
        "ssm-steps.png": (results.ssm, figures.draw_steps),
        "training.png": ([row for rows in results.rows for row in rows.rows], figures.draw_training),
        **{
            f"experiment-{number}.png": (motion, figures.draw_experiment)
            for number, motion in enumerate(results.lstm[0].motions if results.lstm else (), start=1)
        },
        "virtual-track.png": (results.virtual_track, figures.draw_virtual_track),
    }
    return {name: partial(draw, part) for name, (part, draw) in parts.items() if part}


def evaluate_findings(results: ReproduceResults) -> list[PaperFinding]:
    """Evaluate the findings of the parts that were run."""
    published = load_published()
    rows = [row for rows in results.rows for row in rows.rows]
    rules_by_part: list[tuple[Any, Callable[[Any, Published], list[PaperFinding]]]] = [
        (results.mbm_sm, mbm_and_sm.mbm_sm_findings),
        (results.ssm, state_space.ssm_findings),
        (results.lstm or rows, lambda _, published: networks.network_findings(results.lstm, rows, published)),
        (results.cost, cost.cost_findings),
        (results.virtual_track, virtual_track.virtual_track_findings),
        (results.driven_track, virtual_track.driven_track_findings),
        (results.drive_models, drive_models.drive_model_findings),
    ]
    return [finding for part, rules in rules_by_part if part for finding in rules(part, published)]


def findings_table(findings: Sequence[PaperFinding], repetitions: int) -> Table:
    """Tabulate every finding with its verdict."""
    rows = tuple(
        (finding.claim, finding.source, finding.published, finding.plant, finding.verdict) for finding in findings
    )
    count = "one repetition" if repetitions == 1 else f"{repetitions} repetitions with different drives and noise"
    note = (
        f"From {count}. Holds: in all repetitions (yes), in none (no), or in a number of them; inconclusive: the "
        "values do not decide the finding. Values are means over repetitions."
    )
    columns = ("finding", "source", "published", "on our plant", "holds")
    return Table("Findings", columns, rows, text_columns=len(columns), note=note)
