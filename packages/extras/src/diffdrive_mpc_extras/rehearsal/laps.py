"""`diffdrive-mpc rehearse`: one case driven lap by lap, with rehearsal and without."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from diffdrive_mpc.app.run_log import holds_plans, repeat_arguments, run_log
from diffdrive_mpc.bench.case import Case
from diffdrive_mpc.bench.controllers import build_plant, load_reference, make_controller
from diffdrive_mpc.bench.html_report.page import Axis, Chart, Mark, Series, Shown, Warned
from diffdrive_mpc.bench.peers import PEERS
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
    """Root mean squares of the position error of laps [m]; their squares add up to that of all laps."""

    repeating: float
    """Part that repeats at the same time of every lap."""
    varying: float
    """Rest, which no correction learned from other laps can remove."""


def lap_parts(runs: Sequence[Run]) -> LapParts:
    """Split the position errors of K laps into their mean over the laps and the rest.

    Of that rest 1 / K is still in the mean; both parts are without that bias.

    Raises
    ------
    ValueError
        If there are fewer than two laps, or they have not the same ticks.
    """
    shapes = {run.true_pose[run.counted].shape for run in runs}
    if len(runs) < 2 or len(shapes) > 1:
        raise ValueError(f"{len(runs)} laps of {len(shapes)} lengths: give two or more that were driven to the end")
    errors = np.array([(run.true_pose - run.reference_pose)[run.counted, :2] for run in runs])
    mean = errors.mean(axis=0)
    varying = np.sum((errors - mean) ** 2) / (len(runs) - 1) / mean.shape[0]
    repeating = np.sum(mean**2) / mean.shape[0] - varying / len(runs)
    return LapParts(float(np.sqrt(max(repeating, 0.0))), float(np.sqrt(varying)))


_ENABLED = "expert.rehearsal.enabled"


@dataclass(frozen=True)
class Laps:
    """Runs along one reference, in order, and the corrections learned before the last."""

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
    """Drive a case lap by lap with one controller; the robot is put back to the start before each.

    Parameters
    ----------
    case
        Case of the predictive controller.
    laps
        Number of laps. The first has the noise of the case, each later lap noise of a seed that follows from it.
    on_tick
        As in `sim.loop.simulate`, over all laps.
    surfaces
        Surface of each lap in place of that of the case.
    keep_plans
        As in `sim.loop.simulate`.
    """
    controller, reference = make_controller(case), load_reference(case)
    runs = []
    for lap in range(laps):
        seed = case.seed if lap == 0 else int(np.random.SeedSequence((case.seed, lap)).generate_state(1)[0])
        floor = surfaces[lap] if surfaces else case.surface
        done = None if on_tick is None else _after(lap, laps, on_tick)
        plant = build_plant(replace(case, seed=seed, surface=floor))
        runs.append(simulate(controller, plant, reference, keep_plans=keep_plans, on_tick=done))
    return Laps(tuple(runs), _learned(controller))


def _learned(controller: TrackingController) -> LapLearner | FloorRehearsal | None:
    """Return the values that the feature `rehearsal` of a controller learned; None if it has no such feature."""
    if not isinstance(controller, Controller) or not rehearsal_of(controller.config).is_enabled:
        return None
    feature: Rehearse = controller.feature("rehearsal")
    return feature.learned


def _after(lap: int, laps: int, on_tick: Callable[[int, int], None]) -> Callable[[int, int], None]:
    return lambda done, total: on_tick(lap * total + done, laps * total)


class LapsStudy(Study[Case, tuple[Laps, Laps]]):
    """Laps with rehearsal and without.

    Parameters
    ----------
    case
        Case that is driven; raises ConfigError if a peer controls it.
    laps
        Number of laps.
    log
        File for the log of the last lap with rehearsal; None for no log.
    """

    name = "rehearse"
    title = "Laps with rehearsal"

    def __init__(self, case: Case, laps: int, log: Path | None) -> None:
        if case.controller in PEERS:
            raise ConfigError(f"--controller {case.controller}: it does not learn from laps; mpc does")
        self._case, self._laps, self._log = case, laps, log

    def plan(self) -> Case:
        """Return the case; raises ConfigError or ValueError if a name or a value of it cannot be used."""
        make_controller(self._case), build_plant(self._case), load_reference(self._case)
        return self._case

    def cases(self, plan: Case) -> Iterable[Case]:
        """Return the case."""
        return [plan]

    def run(self, plan: Case, jobs: int, bar: ProgressBar) -> tuple[Laps, Laps]:
        """Drive both, and write the log."""
        del jobs
        with run_log(self._log) as write_log:
            learned, plain = (
                drive_laps(
                    plan.with_override(_ENABLED, value=rehearses),
                    self._laps,
                    on_tick=_after(part, 2, bar.show),
                    keep_plans=rehearses and holds_plans(self._log),
                )
                for part, rehearses in enumerate((True, False))
            )
            write_log(learned.runs[-1], plan, ["rehearse", "--laps", str(self._laps), *repeat_arguments(plan)])
        return learned, plain

    def report(self, results: tuple[Laps, Laps], seconds: float) -> Report:
        """Return the table of the laps, the error lap by lap, and the last correction."""
        del seconds
        learned, plain = results
        table = lap_table(learned, plain)
        return Report(
            counted=f"{2 * self._laps} laps",
            meta={"case": self._case.labels, "laps": self._laps},
            content={"laps": [dict(zip(table.columns, row, strict=True)) for row in table.rows]},
            facts=[f"{self._case.labels['trajectory']}, {self._laps} laps with rehearsal and as many without."],
            tables=[table],
            figures={"laps.png": lap_charts(learned, plain)},
            shown=Shown(
                warnings=[
                    Warned(f"Lap {lap}: {message}.", "")
                    for lap, run in enumerate(learned.runs, start=1)
                    for message in dict.fromkeys(filter(None, (*run.messages, run.ended)))
                ]
            ),
        )


def lap_table(learned: Laps, plain: Laps) -> Table:
    """Return a row for each lap; an error repeats as far as it exceeds the part that differs without rehearsal."""
    parts = lap_parts(plain.runs)
    rows = []
    for lap, (run, without) in enumerate(zip(learned.runs, plain.runs, strict=True), start=1):
        position = run.metrics.position_rmse_m
        repeating = float(np.sqrt(max(position**2 - parts.varying**2, 0.0)))
        shown = position, repeating, run.metrics.lateral_rmse_m, without.metrics.position_rmse_m
        rows.append((str(lap), *(number(1e3 * value, 2) for value in shown)))
    heads = ("lap", "position RMSE [mm]", "repeating part [mm]", "lateral RMSE [mm]", "without rehearsal [mm]")
    repeats, varying = 1e3 * parts.repeating, 1e3 * parts.varying
    note = f"Without rehearsal {repeats:.2f} mm repeat and {varying:.2f} mm do not: the lower bound."
    return Table("Laps", heads, tuple(rows), note=note)


def lap_charts(learned: Laps, plain: Laps) -> list[Chart]:
    """Return the error lap by lap, and the correction over time."""
    laps = list(range(1, len(learned.runs) + 1))
    errors = [
        Series(
            name,
            laps,
            [round(1e3 * run.metrics.position_rmse_m, 3) for run in driven.runs],
            i,
            labels={"controller": name},
        )
        for i, (name, driven) in enumerate((("with rehearsal", learned), ("without rehearsal", plain)))
    ]
    level = [Mark(round(1e3 * lap_parts(plain.runs).varying, 3), "does not repeat")]
    charts = [Chart("Error lap by lap", Axis("lap", "category"), Axis("position RMSE [mm]"), errors, marks=level)]
    if learned.rehearsal is None:
        return charts
    time, rows = learned.rehearsal.time.round(3).tolist(), (1e3 * learned.rehearsal.correction).round(2)
    parts = [Series(name, time, rows[:, i].tolist(), i + 2, "line") for i, name in enumerate(("along", "across"))]
    return [*charts, Chart("Correction in the last lap", Axis("time [s]"), Axis("correction [mm]"), parts)]
