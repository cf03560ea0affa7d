"""Run one case for the command line."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

from diffdrive_mpc.bench.atomic import staged
from diffdrive_mpc.bench.case import NO_SCENARIO, Case, build
from diffdrive_mpc.bench.console import output_console
from diffdrive_mpc.bench.controllers import NO_MODEL, PEERS, default_model
from diffdrive_mpc.bench.groups import groups
from diffdrive_mpc.bench.progress import ProgressBar
from diffdrive_mpc.bench.runner import Outcome
from diffdrive_mpc.bench.sweep import single_settings
from diffdrive_mpc.bench.tables import error_table, path_table, scenario_table, summary_table
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.whole_file import whole_file
from diffdrive_mpc.sim import simulate
from diffdrive_mpc.sim.log_csv import write_rows

_MESSAGES_SHOWN = 5


def simulate_one(
    *,
    controller: str,
    model: str | None,
    trajectory: str,
    plant: str,
    surface: str,
    sensors: str,
    scenario: str,
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
        If a name, a file, a value or a place to write to cannot be used; before the run, and nothing is made then.
    """
    peer = controller in PEERS
    if peer and (settings or config is not None or model is not None):
        raise ConfigError(f"the controller '{controller}' takes no --model, --config or --set")
    if model is not None and not model.strip():
        raise ConfigError("--model: it is empty; give mbm, sm, ssm or the path of a model file")
    case = Case(
        controller,
        NO_MODEL if peer else default_model(config) if model is None else model,
        trajectory,
        plant,
        surface,
        sensors,
        seed,
        None if config is None else str(config),
        single_settings(settings),
        scenario,
    )
    parts = build(case)
    with ExitStack() as stack:
        draft = None if log is None else stack.enter_context(_log_file(log))
        folder = None if out is None else stack.enter_context(staged(out))
        with ProgressBar("simulating") as bar:
            run = simulate(*parts, on_tick=bar.at)
        if draft is not None:
            write_rows(run, draft)
        if folder is not None:
            _draw(Outcome(case, run), folder)
    _print(Outcome(case, run))


@contextmanager
def _log_file(log: Path) -> Iterator[Path]:
    """Where to write the log to; a refusal names the option."""
    with ExitStack() as stack:
        try:
            draft = stack.enter_context(whole_file(log))
        except ConfigError as error:
            raise ConfigError(f"--log {error}") from error
        yield draft


def _print(outcome: Outcome) -> None:
    console = output_console()
    tables = [summary_table([outcome]), error_table([outcome]), path_table([outcome])]
    if outcome.case.scenario != NO_SCENARIO:
        tables.append(scenario_table([outcome]))
    for table in tables:
        console.print(table.rich())
    if outcome.run.ended:
        console.print(f"not completed: {outcome.run.ended}", markup=False, highlight=False)
    said = [message for message in dict.fromkeys(outcome.run.messages) if message]
    for message in said[:_MESSAGES_SHOWN]:
        console.print(f"controller: {message}", markup=False, highlight=False)
    if len(said) > _MESSAGES_SHOWN:
        console.print(f"and {len(said) - _MESSAGES_SHOWN} other messages", highlight=False)


def _draw(outcome: Outcome, folder: Path) -> None:
    from diffdrive_mpc.bench.figures.case import draw_case  # noqa: PLC0415 - matplotlib loads slowly
    from diffdrive_mpc.bench.figures.draw import file_name  # noqa: PLC0415
    from diffdrive_mpc.bench.figures.step_time import draw_step_times  # noqa: PLC0415

    (who,) = groups([outcome])
    title = f"{who}, {outcome.case.labels['trajectory']}"
    draw_case(outcome.run, f"{title}, seed {outcome.case.seed}", folder / f"{file_name(title)}.png")
    draw_step_times([outcome], folder / f"{file_name(title)}-step-time.png")
