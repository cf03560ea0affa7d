"""One case for `diffdrive-mpc simulate`: run it, print its tables, draw it, log it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import typer

from diffdrive_mpc.bench.animation.animate import FilmFile, film_draft, write_film
from diffdrive_mpc.bench.animation.playback import from_columns
from diffdrive_mpc.bench.animation.watched import Watched
from diffdrive_mpc.bench.atomic import staged
from diffdrive_mpc.bench.case import NO_MODEL, NO_SCENARIO, Case
from diffdrive_mpc.bench.controllers import build, chosen_model, controller_config
from diffdrive_mpc.bench.outcomes import Outcome, by_driver
from diffdrive_mpc.bench.peers import PEERS
from diffdrive_mpc.bench.progress import ProgressBar, output_console
from diffdrive_mpc.bench.studies.comparison.tables import error_table, path_table, scenario_table, summary_table
from diffdrive_mpc.bench.sweep import single_settings
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.interface import Reference, TrackingController
from diffdrive_mpc.models.whole_file import whole_file
from diffdrive_mpc.mpc.trajectories.speed_check import steps_beyond_slew
from diffdrive_mpc.sim import simulate
from diffdrive_mpc.sim.log_csv import write_rows
from diffdrive_mpc.sim.metrics.tracking_errors import metric_settings
from diffdrive_mpc.sim.plants.plant import Plant
from diffdrive_mpc.sim.view.body import robot_body
from diffdrive_mpc.sim.view.viewer import Viewer

_MESSAGES_SHOWN = 5
_POINTS = 2000
"""Of the reference in the viewer."""


def simulate_one(
    values: Mapping[str, Any],
    *,
    config: Path | None,
    settings: Sequence[str],
    out: Path | None,
    log: Path | None,
    scaled: bool = False,
    film: FilmFile | None = None,
    view: bool = False,
) -> None:
    """Run a case, print its tables, and write figures and log where asked.

    Parameters
    ----------
    values
        By dimension, `model` being None where it was not given.
    config, settings, out, log, scaled
        As typed.
    film
        The film to make of it.
    view
        Whether it is watched in MuJoCo's viewer.

    Raises ConfigError, ValueError or OSError if a name, a file, a value or a place to write to cannot be used; before
    the run, and nothing is made then.
    """
    case = asked_case(values, config=config, settings=settings, scaled=scaled)
    parts = build(case)
    with ExitStack() as stack:
        draft = None if log is None else stack.enter_context(log_file(log))
        folder = None if out is None else stack.enter_context(staged(out))
        reel = None if film is None else stack.enter_context(film_draft(film.path, "--animate"))
        controller, plant, reference = parts
        if view:
            controller = stack.enter_context(watched(case, controller, plant, reference))
        with ProgressBar("simulating") as bar:
            run = simulate(controller, plant, reference, on_tick=bar.at, keep_plans=reel is not None)
        if draft is not None:
            write_rows(run, draft)
        if folder is not None:
            draw(Outcome(case, run), folder)
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


@contextmanager
def watched(
    case: Case, controller: TrackingController, plant: Plant, reference: Reference
) -> Iterator[TrackingController]:
    """Open the viewer, and give the controller as one that is watched; raises NoDisplayError where it cannot open."""
    path = reference.sample(np.linspace(0.0, reference.duration, _POINTS)).pose
    body = robot_body(case.plant) or robot_body()
    assert body is not None
    with Viewer(body, case.surface, path[:, :2], metric_settings().band, path[0]) as viewer:
        yield Watched(controller, plant, viewer)
        closed = not viewer.open
    if closed:
        typer.echo("the viewer was closed; the run went on without it, as fast as it could")


def command_limits(case: Case) -> tuple[float, float] | None:
    """Largest v [m/s] and omega [rad/s] that the controller of a case commands; None for a peer."""
    if case.controller in PEERS:
        return None
    limits = controller_config(case.model, case.config, case.overrides).limits
    return limits.v, limits.omega


@contextmanager
def log_file(log: Path) -> Iterator[Path]:
    """Where to write the log to; a refusal names the option."""
    with ExitStack() as stack:
        try:
            draft = stack.enter_context(whole_file(log))
        except ConfigError as error:
            raise ConfigError(f"--log {error}") from error
        yield draft


def report(outcome: Outcome) -> None:
    """Print the tables of a run, and what its controller said."""
    console = output_console()
    shown = [summary_table, error_table, path_table]
    for make in (*shown, scenario_table) if outcome.case.scenario != NO_SCENARIO else shown:
        console.print(make([outcome]).rich())
    if outcome.case.controller not in PEERS:
        config = controller_config(outcome.case.model, outcome.case.config, outcome.case.overrides)
        steps = steps_beyond_slew(outcome.run.reference, config.limits, config.sample_time)
        if steps:
            console.print(steps, markup=False, highlight=False)
    if outcome.run.ended:
        console.print(f"not completed: {outcome.run.ended}", markup=False, highlight=False)
    said = [message for message in dict.fromkeys(outcome.run.messages) if message]
    for message in said[:_MESSAGES_SHOWN]:
        console.print(f"controller: {message}", markup=False, highlight=False)
    if len(said) > _MESSAGES_SHOWN:
        console.print(f"and {len(said) - _MESSAGES_SHOWN} other messages", highlight=False)


def draw(outcome: Outcome, folder: Path) -> None:
    """Draw a run and its step times into `folder`."""
    from diffdrive_mpc.bench.figure_style import file_name  # noqa: PLC0415 - matplotlib loads slowly
    from diffdrive_mpc.bench.studies.comparison.figures import draw_case, draw_step_times  # noqa: PLC0415

    (who,) = by_driver([outcome])
    title = f"{who}, {outcome.case.labels['trajectory']}"
    draw_case(outcome.run, f"{title}, seed {outcome.case.seed}", folder / f"{file_name(title)}.png")
    draw_step_times([outcome], folder / f"{file_name(title)}-step-time.png")
