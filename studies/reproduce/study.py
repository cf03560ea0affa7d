"""The papers' experiments on the simulated robot, beside the papers' figures."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from diffdrive_mpc.bench.plain_values import plain
from diffdrive_mpc.bench.progress import ProgressBar
from diffdrive_mpc.bench.runner import run_tasks
from diffdrive_mpc.bench.study import Draw, Report, Study, check_parts
from diffdrive_mpc.bench.table import Table
from studies.reproduce.cost import Cost, cost_findings, cost_table, measure_cost
from studies.reproduce.drive_models import (
    DriveModelsResult,
    compare_on_log,
    compare_on_twin,
    drive_model_findings,
    drive_model_tables,
)
from studies.reproduce.driven_track import (
    DrivenTrack,
    drive_tests,
    driven_track_findings,
    driven_track_tables,
)
from studies.reproduce.mbm_and_sm import (
    MbmSmResult,
    compare_mbm_and_sm,
    fit_table,
    mbm_sm_findings,
    odometry_tables,
)
from studies.reproduce.networks import (
    NetworkResult,
    NetworkRows,
    beside_tables,
    compare_with_ssm,
    network_findings,
    row_table,
    train_rows,
)
from studies.reproduce.published import PARTS, PaperFinding, ReproduceSettings, load_published
from studies.reproduce.slip_scatter import (
    SlipScatter,
    scatter_of,
    slip_scatter_findings,
    slip_scatter_tables,
)
from studies.reproduce.state_space import (
    SsmResult,
    compare_orders,
    free_drive_tables,
    order_table,
    ssm_findings,
)
from studies.reproduce.turn_learning import (
    LearnedTurns,
    learn_turns,
    turn_learning_findings,
    turn_learning_tables,
)
from studies.reproduce.turning import (
    TurningResult,
    turn_steadily,
    turning_findings,
    turning_table,
)
from studies.reproduce.virtual_track import (
    VirtualTrackResult,
    check_virtual_track,
    virtual_track_findings,
    virtual_track_table,
)

Result = (
    SsmResult
    | MbmSmResult
    | NetworkResult
    | NetworkRows
    | DriveModelsResult
    | DrivenTrack
    | SlipScatter
    | TurningResult
    | LearnedTurns
)
Task = Callable[[], Result]


@dataclass(frozen=True)
class ReproduceResults:
    """Results by part; a part that was not run is empty or None.

    Attributes
    ----------
    mbm_sm, ssm, lstm
        One for each repetition.
    rows
        Networks of P1's Table 2, in groups.
    cost
        By name of the model.
    virtual_track
        The printed tests and their lines.
    drive_models
        One for each repetition and each log.
    driven_track
        One for each floor.
    slip_scatter
        One for each floor, for each setting of the drifts, for each repetition.
    turning
        Steady turns, by law and driven.
    learned_turns
        One for each floor.
    """

    mbm_sm: tuple[MbmSmResult, ...] = ()
    ssm: tuple[SsmResult, ...] = ()
    lstm: tuple[NetworkResult, ...] = ()
    rows: tuple[NetworkRows, ...] = ()
    cost: Mapping[str, Cost] | None = None
    virtual_track: VirtualTrackResult | None = None
    drive_models: tuple[DriveModelsResult, ...] = ()
    driven_track: tuple[DrivenTrack, ...] = ()
    slip_scatter: tuple[SlipScatter, ...] = ()
    turning: TurningResult | None = None
    learned_turns: tuple[LearnedTurns, ...] = ()


class ReproduceStudy(Study[list[Task], ReproduceResults]):
    """The parts of `settings` that are named in `only`; with `data`, the folder of the real logs, those too."""

    name = "reproduce"
    title = "The papers repeated"

    def __init__(self, settings: ReproduceSettings, only: Sequence[str] = PARTS, data: Path | None = None) -> None:
        self.settings = settings
        self._only = only
        self._data = data

    def plan(self) -> list[Task]:
        """What is repeated, the longest first: a long one at the end would keep one core waiting."""
        check_parts(self._only, PARTS)
        s, only = self.settings, self._only
        tasks: list[Task] = []
        if "lstm" in only:
            networks, first = load_published().networks, s.repetitions[0]
            for rows in s.lstm.rows:
                tasks.append(partial(train_rows, s.lstm, {row: networks[row] for row in rows}, first))
            tasks += [partial(compare_with_ssm, s.lstm, k) for k in s.repetitions]
        tasks += [partial(compare_orders, s.ssm, k) for k in s.repetitions if "ssm" in only]
        if "drive_models" in only:
            if self._data:
                tasks += [partial(compare_on_log, name, self._data) for name in s.drive_models.logs]
            tasks += [partial(compare_on_twin, s.drive_models, k) for k in s.repetitions[: s.drive_models.repetitions]]
        if "slip_scatter" in only:
            own = s.slip_scatter
            tasks += [partial(scatter_of, own, f, d, k) for f in own.floors for d in own.drifts for k in s.repetitions]
        if "turning" in only:
            tasks += [partial(learn_turns, s.turning, floor) for floor in s.turning.floors]
            tasks.append(partial(turn_steadily, s.turning))
        if "virtual_track" in only:
            tasks += [partial(drive_tests, s.driven_track, surface) for surface in s.driven_track.surfaces]
        return tasks + [partial(compare_mbm_and_sm, s.mbm_sm, k) for k in s.repetitions if "mbm_sm" in only]

    def run(self, plan: list[Task], jobs: int, bar: ProgressBar) -> ReproduceResults:
        """Repetitions in several processes, then, on a quiet machine, what is timed."""
        timed = "cost" in self._only
        bar.begin("running", len(plan) + 2 * self.settings.cost.runs * timed)
        done = run_tasks(plan, jobs, bar.advance)
        driven = sorted((one for one in done if isinstance(one, DriveModelsResult)), key=lambda row: -row.repetition)
        tracked, published = "virtual_track" in self._only, load_published()
        return ReproduceResults(
            ssm=tuple(result for result in done if isinstance(result, SsmResult)),
            mbm_sm=tuple(result for result in done if isinstance(result, MbmSmResult)),
            lstm=tuple(result for result in done if isinstance(result, NetworkResult)),
            rows=tuple(result for result in done if isinstance(result, NetworkRows)),
            drive_models=tuple(driven),
            driven_track=tuple(result for result in done if isinstance(result, DrivenTrack)),
            slip_scatter=tuple(result for result in done if isinstance(result, SlipScatter)),
            turning=next((result for result in done if isinstance(result, TurningResult)), None),
            learned_turns=tuple(result for result in done if isinstance(result, LearnedTurns)),
            cost=measure_cost(self.settings.cost, bar.advance) if timed else None,
            virtual_track=check_virtual_track(published.virtual_track, published.rules.certain) if tracked else None,
        )

    def report(self, results: ReproduceResults, seconds: float) -> Report:
        """Findings with their verdicts first; every result is written but paths, which would fill the file."""
        parts = [part for part in PARTS if getattr(results, part)]
        written = plain(results)
        for result in (*written["mbm_sm"], *written["slip_scatter"]):
            del result["paths"]
        for floor in written["learned_turns"]:
            floor["runs"] = [
                {"seed": run["seed"], **{name: run[name][-1] for name in ("measured", "learned", "prior")}}
                for run in floor["runs"]
            ]
        findings = find(results)
        repetitions = ", ".join(map(str, self.settings.repetitions))
        where = f"plant mujoco, surface default, sensors default, repetitions {repetitions}"
        return Report(
            counted="one part" if len(parts) == 1 else f"{len(parts)} parts",
            meta={"parts": parts},
            content={
                "findings": [plain(finding) | {"verdict": finding.verdict} for finding in findings],
                "study": self.settings,
                **written,
            },
            facts=[f"Parts {', '.join(parts)} in {seconds} s; {where}."],
            tables=report_tables(results, findings_table(findings, len(self.settings.repetitions)), self.settings),
            figures=_drawings(results),
        )


def report_tables(results: ReproduceResults, findings: Table, settings: ReproduceSettings) -> list[Table]:
    """Those of the parts that were run, the findings first."""
    published = load_published()
    tables = [findings]
    if results.mbm_sm:
        tables += [fit_table(results.mbm_sm, published), *odometry_tables(results.mbm_sm, published)]
    if results.ssm:
        tables += [order_table(results.ssm, published), *free_drive_tables(results.ssm, published)]
    if results.rows:
        tables.append(row_table([row for rows in results.rows for row in rows.rows], published))
    if results.lstm:
        tables += beside_tables(results.lstm, published)
    if results.cost is not None:
        tables.append(cost_table(results.cost, published))
    if results.virtual_track is not None:
        tables.append(virtual_track_table(results.virtual_track))
    if results.driven_track:
        tables += driven_track_tables(results.driven_track, published)
    if results.drive_models:
        tables += drive_model_tables(results.drive_models, published)
    if results.slip_scatter:
        tables += slip_scatter_tables(results.slip_scatter, settings.slip_scatter.horizon)
    if results.turning is not None:
        tables.append(turning_table(results.turning))
    if results.learned_turns:
        tables += turn_learning_tables(results.learned_turns, published)
    return tables


def _drawings(results: ReproduceResults) -> dict[str, Draw]:
    """Figures of the parts that were run."""
    from studies.reproduce import figures, turn_figures  # noqa: PLC0415 - matplotlib loads slowly

    drawn: dict[str, Draw] = {}
    if results.mbm_sm:
        drawn["odometry.png"] = partial(figures.draw_odometry, results.mbm_sm)
    if results.ssm:
        drawn["orders.png"] = partial(figures.draw_orders, results.ssm)
    if results.virtual_track is not None:
        drawn["virtual-track.png"] = partial(figures.draw_virtual_track, results.virtual_track)
    if results.slip_scatter:
        drawn["slip-scatter.png"] = partial(figures.draw_slip_scatter, results.slip_scatter)
    if results.turning is not None:
        drawn["turn-torques.png"] = partial(turn_figures.draw_turn_torques, results.turning)
        drawn["turn-power.png"] = partial(turn_figures.draw_turn_power, results.turning)
    if results.learned_turns:
        drawn["turn-learning.png"] = partial(turn_figures.draw_turn_learning, results.learned_turns)
        drawn["turn-energy.png"] = partial(turn_figures.draw_turn_energy, results.learned_turns)
    return drawn


def find(results: ReproduceResults) -> list[PaperFinding]:
    """Every rule that the parts of `results` can decide."""
    published = load_published()
    findings: list[PaperFinding] = []
    if results.mbm_sm:
        findings += mbm_sm_findings(results.mbm_sm, published)
    if results.ssm:
        findings += ssm_findings(results.ssm, published)
    if results.lstm or results.rows:
        rows = [row for rows in results.rows for row in rows.rows]
        findings += network_findings(results.lstm, rows, published)
    if results.cost is not None:
        findings += cost_findings(results.cost, published)
    if results.virtual_track is not None:
        findings += virtual_track_findings(results.virtual_track, published)
    if results.driven_track:
        findings += driven_track_findings(results.driven_track, published)
    if results.drive_models:
        findings += drive_model_findings(results.drive_models, published)
    if results.slip_scatter:
        findings += slip_scatter_findings(results.slip_scatter, published)
    if results.turning is not None:
        findings += turning_findings(results.turning, published)
    if results.learned_turns:
        findings += turn_learning_findings(results.learned_turns, published)
    return findings


def findings_table(findings: Sequence[PaperFinding], repetitions: int) -> Table:
    """Every rule with its verdict."""
    rows = tuple(
        (finding.claim, finding.source, finding.published, finding.plant, finding.verdict) for finding in findings
    )
    count = "one repetition" if repetitions == 1 else f"{repetitions} repetitions, with drives and noise of their own"
    note = (
        f"From {count}. Holds: in all (yes), in none (no), or in how many; inconclusive: the numbers do not decide it. "
        "Numbers are means over repetitions."
    )
    columns = ("finding", "source", "published", "on our plant", "holds")
    return Table("Findings", columns, rows, text_columns=len(columns), note=note)
