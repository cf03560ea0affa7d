"""Run one case for the command line."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

from bench.atomic import staged
from bench.case import Case, run_case
from bench.console import output_console
from bench.controllers import NO_MODEL, PEERS, default_model
from bench.progress import ProgressBar
from bench.results import groups
from bench.runner import Outcome
from bench.sweep import single_settings
from bench.tables import error_table, path_table, summary_table
from models.checked_yaml import ConfigError
from sim.log_csv import write_log

_MESSAGES_SHOWN = 5


def simulate_one(
    *,
    controller: str,
    model: str | None,
    trajectory: str,
    plant: str,
    surface: str,
    sensors: str,
    seed: int,
    config: Path | None,
    settings: Sequence[str],
    out: Path | None,
    log: Path | None,
) -> None:
    """Run a case, print its tables, and write figures and log where asked; parameters as the command's options.

    Raises
    ------
    models.checked_yaml.ConfigError, ValueError, OSError
        If a name, a file, a value or a place to write to cannot be used.
    """
    peer = controller in PEERS
    if peer and (settings or config or model):
        raise ConfigError(f"the controller '{controller}' takes no --model, --config or --set")
    case = Case(
        controller,
        NO_MODEL if peer else model or default_model(config),
        trajectory,
        plant,
        surface,
        sensors,
        seed,
        None if config is None else str(config),
        single_settings(settings),
    )
    with ExitStack() as stack:
        folder = None if out is None else stack.enter_context(staged(out))
        with ProgressBar("simulating") as bar:
            run = run_case(case, on_tick=bar.at)
        if log is not None:
            _make_folder(log)
            write_log(run, log)
        if folder is not None:
            _draw(Outcome(case, run), folder)
    _print(Outcome(case, run))


def _make_folder(log: Path) -> None:
    try:
        log.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"--log {log}: the folder '{log.parent}' cannot be made ({error.strerror})") from error


def _print(outcome: Outcome) -> None:
    console = output_console()
    for table in (summary_table([outcome]), error_table([outcome]), path_table([outcome])):
        console.print(table.rich())
    said = [message for message in dict.fromkeys(outcome.run.messages) if message]
    for message in said[:_MESSAGES_SHOWN]:
        console.print(f"controller: {message}", markup=False, highlight=False)
    if len(said) > _MESSAGES_SHOWN:
        console.print(f"and {len(said) - _MESSAGES_SHOWN} other messages", highlight=False)


def _draw(outcome: Outcome, folder: Path) -> None:
    from bench.figures.case import draw_case  # noqa: PLC0415 - matplotlib loads slowly
    from bench.figures.draw import file_name  # noqa: PLC0415
    from bench.figures.step_time import draw_step_times  # noqa: PLC0415

    (who,) = groups([outcome])
    title = f"{who}, {outcome.case.labels['trajectory']}"
    draw_case(outcome.run, f"{title}, seed {outcome.case.seed}", folder / f"{file_name(title)}.png")
    draw_step_times([outcome], folder / f"{file_name(title)}-step-time.png")
