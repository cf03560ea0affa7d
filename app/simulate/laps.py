"""`diffdrive-mpc simulate --laps`: one case driven again and again, with rehearsal and without."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from diffdrive_mpc.app.run_log import holds_plans, repeating, run_log
from diffdrive_mpc.app.simulate.single import case_from_options, draw_figures
from diffdrive_mpc.app.simulate.single_page import laps_page
from diffdrive_mpc.bench.case import Case
from diffdrive_mpc.bench.controllers import build_plant, load_reference, make_controller
from diffdrive_mpc.bench.html_report.document import write_page
from diffdrive_mpc.bench.html_report.page import Axis, Chart, Mark, Series
from diffdrive_mpc.bench.peers import PEERS
from diffdrive_mpc.bench.progress import ProgressBar, output_console
from diffdrive_mpc.bench.report_folder import REPORT, staged
from diffdrive_mpc.bench.run_row import RunOutcome
from diffdrive_mpc.bench.table import Table, number
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.mpc import Controller
from diffdrive_mpc.sim import Run, simulate
from diffdrive_mpc.sim.laps import lap_parts
from diffdrive_mpc_extras.rehearsal.feature import Rehearse
from diffdrive_mpc_extras.rehearsal.floor_rehearsal import FloorRehearsal
from diffdrive_mpc_extras.rehearsal.rehearsal import LapLearner

_ENABLED = "rehearsal.enabled"


@dataclass(frozen=True)
class Laps:
    """Runs along one reference, in order, and what was learned before the last."""

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
        Of the predictive controller.
    laps
        How many. The first has the case's own noise, each other one noise from a seed that follows from the case's.
    on_tick
        As `sim.loop.simulate` has it, over all laps.
    surfaces
        Floor of each lap, where that is not the case's.
    keep_plans
        As `sim.loop.simulate` has it.
    """
    controller, reference = make_controller(case), load_reference(case)
    runs = []
    for lap in range(laps):
        seed = case.seed if lap == 0 else int(np.random.SeedSequence((case.seed, lap)).generate_state(1)[0])
        floor = surfaces[lap] if surfaces else case.surface
        done = None if on_tick is None else _after(lap, laps, on_tick)
        plant = build_plant(replace(case, seed=seed, surface=floor))
        runs.append(simulate(controller, plant, reference, keep_plans=keep_plans, on_tick=done))
    return Laps(tuple(runs), _learner(controller))


def _learner(controller: object) -> LapLearner | FloorRehearsal | None:
    """Return what the feature rehearsal has learned; None without it."""
    feature = controller.features.get("rehearsal") if isinstance(controller, Controller) else None
    return feature.learned if isinstance(feature, Rehearse) else None


def _after(lap: int, laps: int, on_tick: Callable[[int, int], None]) -> Callable[[int, int], None]:
    return lambda done, total: on_tick(lap * total + done, laps * total)


def simulate_laps(
    values: Mapping[str, Any],
    *,
    laps: int,
    config: Path | None,
    settings: Sequence[str],
    out: Path | None,
    log: Path | None,
    scaled: bool = False,
) -> None:
    """Drive laps with rehearsal and without, print them in a table, and write figures and the last log where asked.

    Arguments and errors are those of `simulate_one`.
    """
    case = case_from_options(values, config=config, settings=settings, scaled=scaled)
    if case.controller in PEERS:
        raise ConfigError(f"--laps: the controller '{case.controller}' does not learn from laps; mpc does")
    with ExitStack() as stack:
        write_log = stack.enter_context(run_log(log))
        folder = None if out is None else stack.enter_context(staged(out, owner="simulate"))
        began = time.perf_counter()
        with ProgressBar("laps") as bar:
            learned = drive_laps(
                case.with_override(_ENABLED, value=True),
                laps,
                on_tick=_after(0, 2, bar.at),
                keep_plans=holds_plans(log),
            )
            plain = drive_laps(case.with_override(_ENABLED, value=False), laps, on_tick=_after(1, 2, bar.at))
        write_log(learned.runs[-1], case, ["--laps", str(laps), *repeating(case)])
        if folder is not None:
            from diffdrive_mpc.bench.chart_drawing import draw_charts  # noqa: PLC0415 - matplotlib loads slowly

            draw_figures(RunOutcome(case, learned.runs[-1]), folder)
            draw_charts(lap_charts(learned, plain), folder / "laps.png")
            seconds = time.perf_counter() - began
            page = laps_page(
                case, learned.runs, plain.runs, lap_table(learned, plain), lap_charts(learned, plain), seconds
            )
            write_page(page, folder / REPORT)
    console = output_console()
    console.print(lap_table(learned, plain).rich())
    for lap, run in enumerate(learned.runs, start=1):
        for message in dict.fromkeys(filter(None, (*run.messages, run.ended))):
            console.print(f"lap {lap}: {message}", markup=False, highlight=False)


def lap_table(learned: Laps, plain: Laps) -> Table:
    """A row for each lap; what repeats is what is more than the part that does not repeat without rehearsal."""
    parts = lap_parts(plain.runs)
    rows = []
    for lap, (run, without) in enumerate(zip(learned.runs, plain.runs, strict=True), start=1):
        position = run.metrics.position_rmse_m
        repeating = float(np.sqrt(max(position**2 - parts.other**2, 0.0)))
        shown = position, repeating, run.metrics.lateral_rmse_m, without.metrics.position_rmse_m
        rows.append((str(lap), *(number(1e3 * value, 2) for value in shown)))
    heads = ("lap", "position RMSE [mm]", "repeating part [mm]", "lateral RMSE [mm]", "without rehearsal [mm]")
    repeats, other = 1e3 * parts.repeating, 1e3 * parts.other
    note = f"Without rehearsal {repeats:.2f} mm repeat and {other:.2f} mm do not: the lower bound."
    return Table("Laps", heads, tuple(rows), note=note)


def lap_charts(learned: Laps, plain: Laps) -> list[Chart]:
    """The error lap by lap, and the correction over time."""
    laps = list(range(1, len(learned.runs) + 1))
    errors = [
        Series(
            name, laps, [round(1e3 * run.metrics.position_rmse_m, 3) for run in of.runs], i, labels={"controller": name}
        )
        for i, (name, of) in enumerate((("with rehearsal", learned), ("without rehearsal", plain)))
    ]
    level = [Mark(round(1e3 * lap_parts(plain.runs).other, 3), "does not repeat")]
    charts = [Chart("Error lap by lap", Axis("lap", "category"), Axis("position RMSE [mm]"), errors, marks=level)]
    if learned.rehearsal is None:
        return charts
    time_, rows = learned.rehearsal.time.round(3).tolist(), (1e3 * learned.rehearsal.correction).round(2)
    parts = [Series(name, time_, rows[:, i].tolist(), i + 2, "line") for i, name in enumerate(("along", "across"))]
    return [*charts, Chart("Correction in the last lap", Axis("time [s]"), Axis("correction [mm]"), parts)]
