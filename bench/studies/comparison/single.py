"""One case for `diffdrive-mpc simulate`: run it, print its tables, draw it, log it."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from diffdrive_mpc.bench.animation.animate import FilmFile, film_draft, write_film
from diffdrive_mpc.bench.animation.playback import from_columns
from diffdrive_mpc.bench.animation.watched import watched
from diffdrive_mpc.bench.atomic import staged
from diffdrive_mpc.bench.case import NO_MODEL, NO_SCENARIO, Case
from diffdrive_mpc.bench.controllers import build, chosen_model, controller_config
from diffdrive_mpc.bench.html_report.document import REPORT, write_page
from diffdrive_mpc.bench.outcomes import Outcome, by_driver
from diffdrive_mpc.bench.peers import PEERS
from diffdrive_mpc.bench.progress import ProgressBar, output_console
from diffdrive_mpc.bench.rerun_view import ShownController, rerun_view
from diffdrive_mpc.bench.run_log import holds_plans, run_log
from diffdrive_mpc.bench.studies.comparison.single_page import single_page
from diffdrive_mpc.bench.studies.comparison.tables import (
    error_table,
    path_table,
    scenario_table,
    summary_table,
    world_table,
)
from diffdrive_mpc.bench.sweep import single_settings
from diffdrive_mpc.bench.table import Table
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.mpc.trajectories.speed_check import sharper_than_commands, steps_beyond_slew
from diffdrive_mpc.sim import simulate
from diffdrive_mpc.sim.view.body import robot_body

_MESSAGES_SHOWN = 5


def simulate_one(
    values: Mapping[str, Any],
    *,
    config: Path | None,
    settings: Sequence[str],
    out: Path | None,
    log: Path | None,
    rerun: str | None = None,
    scaled: bool = False,
    film: FilmFile | None = None,
    view: bool = False,
) -> None:
    """Run a case, print its tables, and write figures and log where asked.

    Parameters
    ----------
    values
        By dimension, `model` being None where it was not given.
    config, settings, out, log, rerun, scaled
        As typed.
    film
        The film to make of it.
    view
        Whether it is watched in MuJoCo's viewer.

    Raises ConfigError, ValueError or OSError if a name, a file, a value or a place to write to cannot be used; before
    the run, and nothing is made then.
    """
    case = asked_case(values, config=config, settings=settings, scaled=scaled)
    controller, plant, reference = build(case)
    with ExitStack() as stack:
        write_log = stack.enter_context(run_log(log))
        if rerun is not None:
            shown = stack.enter_context(rerun_view(rerun, reference.name))
            controller = ShownController(controller, plant, shown)
        folder = None if out is None else stack.enter_context(staged(out, owner="simulate"))
        reel = None if film is None else stack.enter_context(film_draft(film.path, "--animate"))
        if view:
            controller = stack.enter_context(watched(controller, plant, reference, case.plant, case.surface))
        kept = folder is not None or reel is not None or holds_plans(log)
        began = time.perf_counter()
        with ProgressBar("simulating") as bar:
            run = simulate(controller, plant, reference, on_tick=bar.at, keep_plans=kept)
        write_log(run, case)
        if folder is not None:
            draw(Outcome(case, run), folder, time.perf_counter() - began)
        if film is not None and reel is not None:
            body = robot_body(case.plant)
            write_film(from_columns(run.columns, run.plans, command_limits(case)), film.film, body, reel)
    report(Outcome(case, run))


def asked_case(values: Mapping[str, Any], *, config: Path | None, settings: Sequence[str], scaled: bool) -> Case:
    """The case that was typed; arguments and errors are those of `simulate_one`."""
    name, model = values["controller"], values["model"]
    if name in PEERS and (settings or config is not None or model is not None):
        raise ConfigError(f"the controller '{name}' takes no --model, --config or --set")
    model = NO_MODEL if name in PEERS else chosen_model(model, config)
    file = None if config is None else str(config)
    return Case(**{**values, "model": model}, config=file, overrides=single_settings(settings), scaled=scaled)


def command_limits(case: Case) -> tuple[float, float] | None:
    """Largest v [m/s] and omega [rad/s] that the controller of a case commands; None for a peer."""
    if case.controller in PEERS:
        return None
    limits = controller_config(case.model, case.config, case.overrides).limits
    return limits.v, limits.omega


def report(outcome: Outcome) -> None:
    """Print the tables of a run, and what its controller said."""
    console = output_console()
    for table in tables(outcome):
        console.print(table.rich())
    if outcome.case.controller not in PEERS:
        config = controller_config(outcome.case.model, outcome.case.config, outcome.case.overrides)
        for check in (steps_beyond_slew, sharper_than_commands):
            said = check(outcome.run.reference, config.limits, config.sample_time)
            if said:
                console.print(said, markup=False, highlight=False)
    if outcome.run.ended:
        console.print(f"not completed: {outcome.run.ended}", markup=False, highlight=False)
    messages = [message for message in dict.fromkeys(outcome.run.messages) if message]
    for message in messages[:_MESSAGES_SHOWN]:
        console.print(f"controller: {message}", markup=False, highlight=False)
    if len(messages) > _MESSAGES_SHOWN:
        console.print(f"and {len(messages) - _MESSAGES_SHOWN} other messages", highlight=False)


def tables(outcome: Outcome) -> list[Table]:
    """The tables of one run."""
    shown = [summary_table, error_table, path_table]
    made = [make([outcome]) for make in shown]
    if outcome.case.scenario != NO_SCENARIO:
        made.append(scenario_table([outcome]))
    return [world_table([outcome]), *made] if outcome.run.passage else made


def draw(outcome: Outcome, folder: Path, seconds: float) -> None:
    """Draw a run, which took so many `seconds`, and its step times into `folder`, and write its page."""
    draw_figures(outcome, folder)
    write_page(single_page(outcome, tables(outcome), seconds), folder / REPORT)


def draw_figures(outcome: Outcome, folder: Path) -> None:
    """Draw a run and its step times into `folder`."""
    from diffdrive_mpc.bench.figure_style import file_name  # noqa: PLC0415 - matplotlib loads slowly
    from diffdrive_mpc.bench.studies.comparison.figures import draw_case, draw_step_times  # noqa: PLC0415

    (who,) = by_driver([outcome])
    title = f"{who}, {outcome.case.labels['trajectory']}"
    draw_case(outcome.run, f"{title}, seed {outcome.case.seed}", folder / f"{file_name(title)}.png")
    draw_step_times([outcome], folder / f"{file_name(title)}-step-time.png")
