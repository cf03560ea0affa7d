"""Study `diffdrive-mpc rehearse`: laps of one case, with and without rehearsal."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from diffdrive_mpc.app.run_log import includes_plans, repeat_arguments, run_log
from diffdrive_mpc.bench.case import Case
from diffdrive_mpc.bench.controllers import build_plant, load_reference, make_controller
from diffdrive_mpc.bench.html_report.page import Axis, Chart, Mark, PageContents, PageWarning, Series
from diffdrive_mpc.bench.progress import ProgressBar
from diffdrive_mpc.bench.study import Report, Study
from diffdrive_mpc.bench.table import Table, number
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.interface import TrackingController
from diffdrive_mpc.mpc import Controller
from diffdrive_mpc.sim import Run, simulate
from diffdrive_mpc_extras.rehearsal.config import rehearsal_of
from diffdrive_mpc_extras.rehearsal.feature import Rehearse
from diffdrive_mpc_extras.rehearsal.floor_rehearsal import FloorRehearsal
from diffdrive_mpc_extras.rehearsal.rehearsal import LapLearner


class LapParts(NamedTuple):
    """RMS parts of the position error of laps [m]; the squares add up to the squared RMS error of all laps."""

    repeating: float
    """Part that repeats at equal times of each lap."""
    varying: float
    """Part that varies from lap to lap, which no learned correction can remove."""


def lap_parts(runs: Sequence[Run]) -> LapParts:
    """Split the position errors of K laps into their mean over the laps and the rest.

    The mean contains 1 / K of the varying variance; this bias is removed from both parts.

    Raises
    ------
    ValueError
        If there are fewer than two laps, or the laps have different numbers of ticks.
    """
    shapes = {run.true_pose[run.counted].shape for run in runs}
    if len(runs) < 2 or len(shapes) > 1:
        raise ValueError(f"{len(runs)} laps of {len(shapes)} lengths: give two or more complete laps")
    errors = np.array([(run.true_pose - run.reference_pose)[run.counted, :2] for run in runs])
    mean = errors.mean(axis=0)
    varying = np.sum((errors - mean) ** 2) / (len(runs) - 1) / mean.shape[0]
    repeating = np.sum(mean**2) / mean.shape[0] - varying / len(runs)
    return LapParts(float(np.sqrt(max(repeating, 0.0))), float(np.sqrt(varying)))


_ENABLED = "expert.rehearsal.enabled"


@dataclass(frozen=True)
class Laps:
    """Runs along one reference in order, and the learner after the last run."""

    runs: tuple[Run, ...]
    rehearsal: LapLearner | FloorRehearsal | None


def drive_laps(
    case: Case,
    laps: int,
    *,
    on_tick: Callable[[int, int], None] | None = None,
    surfaces: Sequence[str] = (),
    keep_plans: bool = False,
) -> Laps:
    """Drive laps of a case with one controller; the robot is reset to the start before each lap.

    Parameters
    ----------
    case
        Case of the predictive controller.
    laps
        Number of laps. The first lap uses the seed of the case, each later lap a seed derived from it.
    on_tick
        Callback as in `sim.loop.simulate`, counted over all laps.
    surfaces
        Surface of each lap; by default that of the case.
    keep_plans
        True to store plans, as in `sim.loop.simulate`.
    """
    controller, reference = make_controller(case), load_reference(case)
    runs = []
    for lap in range(laps):
        seed = case.seed if lap == 0 else int(np.random.SeedSequence((case.seed, lap)).generate_state(1)[0])
        floor = surfaces[lap] if surfaces else case.surface
        lap_tick = None if on_tick is None else _offset_tick(lap, laps, on_tick)
        plant = build_plant(replace(case, seed=seed, surface=floor))
        runs.append(simulate(controller, plant, reference, keep_plans=keep_plans, on_tick=lap_tick))
    return Laps(tuple(runs), _learner(controller))


def _learner(controller: TrackingController) -> LapLearner | FloorRehearsal | None:
    """Return the learner of a controller's feature `rehearsal`; None if the controller has no such feature."""
    if not isinstance(controller, Controller) or not rehearsal_of(controller.config).is_enabled:
        return None
    feature: Rehearse = controller.feature("rehearsal")
    return feature.learned


def _offset_tick(lap: int, laps: int, on_tick: Callable[[int, int], None]) -> Callable[[int, int], None]:
    return lambda done, total: on_tick(lap * total + done, laps * total)


class LapsStudy(Study[Case, tuple[Laps, Laps]]):
    """Study of laps with and without rehearsal.

    Parameters
    ----------
    case
        Case to simulate with the MPC.
    laps
        Number of laps.
    log
        File for the log of the last lap with rehearsal; None for no log.
    """

    name = "rehearse"
    title = "Laps with rehearsal"

    def __init__(self, case: Case, laps: int, log: Path | None) -> None:
        if _ENABLED in dict(case.overrides):
            raise ConfigError("--set expert.rehearsal.enabled: remove it; rehearse drives with and without rehearsal")
        self._case, self._laps, self._log = case, laps, log

    def plan(self) -> Case:
        """Return the case; raises ConfigError or ValueError if a name or a value is invalid."""
        make_controller(self._case), build_plant(self._case), load_reference(self._case)
        return self._case

    def cases(self, plan: Case) -> Iterable[Case]:
        """Return the case."""
        return [plan]

    def run(self, plan: Case, jobs: int, bar: ProgressBar) -> tuple[Laps, Laps]:
        """Drive the laps with and without rehearsal, and write the log."""
        del jobs
        with run_log(self._log) as write_log:
            learned, plain = (
                drive_laps(
                    plan.with_override(_ENABLED, value=is_learning),
                    self._laps,
                    on_tick=_offset_tick(part, 2, bar.show),
                    keep_plans=is_learning and includes_plans(self._log),
                )
                for part, is_learning in enumerate((True, False))
            )
            write_log(learned.runs[-1], plan, ["rehearse", "--laps", str(self._laps), *repeat_arguments(plan)])
        return learned, plain

    def report(self, results: tuple[Laps, Laps], seconds: float) -> Report:
        """Return the table of the laps, the error of each lap, and the last correction."""
        del seconds
        learned, plain = results
        sentences = [f"Lap {lap}: {text}." for lap, run in enumerate(learned.runs, start=1) for text in _messages(run)]
        successes = [text for text in sentences if ": learned from" in text]
        table = lap_table(learned, plain)
        table = replace(table, note=" ".join((table.note, *successes)))
        return Report(
            size=f"{2 * self._laps} laps",
            meta={"case": self._case.labels, "laps": self._laps},
            content={"laps": [dict(zip(table.columns, row, strict=True)) for row in table.rows]},
            facts=[f"{self._case.labels['trajectory']}, {self._laps} laps with rehearsal and the same number without."],
            tables=[table],
            figures={"laps.png": lap_charts(learned, plain)},
            shown=PageContents(warnings=[PageWarning(text, "") for text in sentences if text not in successes]),
        )


def _messages(run: Run) -> list[str]:
    """Return the messages of a run and the reason for its end; of messages that differ in numbers only the last one."""
    return list({re.sub(r"[\d.]+", "", text): text for text in (*run.messages, run.ended) if text}.values())


def lap_table(learned: Laps, plain: Laps) -> Table:
    """Return a table with a row for each lap; the repeating part is the error without the varying part."""
    parts = lap_parts(plain.runs)
    rows = []
    for lap, (run, plain_run) in enumerate(zip(learned.runs, plain.runs, strict=True), start=1):
        position = run.metrics.position_rmse_m
        repeating = float(np.sqrt(max(position**2 - parts.varying**2, 0.0)))
        values = position, repeating, run.metrics.lateral_rmse_m, plain_run.metrics.position_rmse_m
        rows.append((str(lap), *(number(1e3 * value, 2) for value in values)))
    heads = ("lap", "position RMSE [mm]", "repeating part [mm]", "lateral RMSE [mm]", "without rehearsal [mm]")
    repeats, varying = 1e3 * parts.repeating, 1e3 * parts.varying
    note = f"Without rehearsal: {repeats:.2f} mm repeat, {varying:.2f} mm vary from lap to lap (lower bound)."
    return Table("Laps", heads, tuple(rows), note=note)


def lap_charts(learned: Laps, plain: Laps) -> list[Chart]:
    """Return the charts of the error of each lap, and of the correction over time."""
    laps = list(range(1, len(learned.runs) + 1))
    errors = [
        Series(
            name,
            laps,
            [round(1e3 * run.metrics.position_rmse_m, 3) for run in result.runs],
            i,
            labels={"controller": name},
        )
        for i, (name, result) in enumerate((("with rehearsal", learned), ("without rehearsal", plain)))
    ]
    level = [Mark(round(1e3 * lap_parts(plain.runs).varying, 3), "varying part")]
    charts = [Chart("Error of each lap", Axis("lap", "category"), Axis("position RMSE [mm]"), errors, marks=level)]
    if learned.rehearsal is None:
        return charts
    time, rows = learned.rehearsal.time.round(3).tolist(), (1e3 * learned.rehearsal.correction).round(2)
    parts = [Series(name, time, rows[:, i].tolist(), i + 2, "line") for i, name in enumerate(("along", "across"))]
    return [*charts, Chart("Correction in the last lap", Axis("time [s]"), Axis("correction [mm]"), parts)]
