"""`diffdrive-mpc models`: what velocity models there are and what they say."""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import Annotated

import typer

from diffdrive_mpc.app.command_line.completion import choices
from diffdrive_mpc.app.command_line.echo import echo
from diffdrive_mpc.app.commands.options import Mapping
from diffdrive_mpc.app.former_names import WithFormerNames

_TWO_MINUTES = 120.0
_INTERRUPTED = 130
"""Exit code of a command that Ctrl-C ended, as shells give it."""

models_app = typer.Typer(cls=WithFormerNames, no_args_is_help=True, help="List, show and check velocity models.")


@models_app.command("list", epilog="Example: diffdrive-mpc models list")
def list_models() -> None:
    """List the shipped models with their order, lags, gains and origin."""
    from diffdrive_mpc.app.model_report import print_models  # noqa: PLC0415 - --help does without it

    print_models()


@models_app.command(epilog="Example: diffdrive-mpc models show ssm")
def show(
    name: Annotated[
        str,
        typer.Argument(
            metavar="NAME|FILE",
            help="mbm, sm, ssm, lstm, p2_experimental, p2_physical, kinematic, or a model file.",
            autocompletion=choices("model"),
        ),
    ],
) -> None:
    """Show one model: matrices, poles, gains, dead times, and where the numbers come from."""
    from diffdrive_mpc.app.model_report import print_model  # noqa: PLC0415

    print_model(name)


@models_app.command(epilog="Example: diffdrive-mpc models check my_robot.yaml")
def check(file: Annotated[str, typer.Argument(metavar="FILE", help="A model file.")]) -> None:
    """Check a model file: keys, stability, gains and units."""
    from diffdrive_mpc.models.load import load_model  # noqa: PLC0415

    model = load_model(file)
    echo(f"{file}: valid, {model.structure.upper()} '{model.name}' with {model.order} states")


@models_app.command(epilog="Example: diffdrive-mpc models compare drive.csv --mapping mine.yaml")
def compare(
    logs: Annotated[list[Path], typer.Argument(metavar="LOG...", help="CSV files or bags, all of one robot.")],
    mapping: Mapping = None,
    kinds: Annotated[
        str,
        typer.Option(
            metavar="LIST",
            help="Kinds to compare, with commas between, or all.",
            show_default="all but hybrid and lstm",
        ),
    ] = "",
    parts: Annotated[int, typer.Option(min=2, help="Parts of the log that are held out in turn.")] = 3,
) -> None:
    """Identify every kind of model from a log, cross-validated, and say which one it supports."""
    from diffdrive_mpc.bench.progress import ProgressBar, output_console  # noqa: PLC0415
    from diffdrive_mpc.bench.table import rich_table  # noqa: PLC0415
    from diffdrive_mpc.models.identification.log_data import read_data  # noqa: PLC0415
    from diffdrive_mpc.models.identification.settings import identification_settings  # noqa: PLC0415
    from diffdrive_mpc_extras.model_comparison.model_comparison import ModelComparison, compare_models  # noqa: PLC0415

    settings = identification_settings()
    with ProgressBar("comparison (minutes)") as bar:
        data = read_data(
            logs,
            [],
            mapping=mapping,
            fit_share=settings.fit_share,
            wheels=False,
            on_findings=lambda _: None,
            most_rows=settings.most_rows["effects"],
        )
        chosen = tuple(name.strip() for name in kinds.split(",")) if kinds else ()
        begun, so_far = time.monotonic(), list[ModelComparison]()

        def show_progress(text: str, share: float) -> None:
            left = (time.monotonic() - begun) * (1.0 - share) / share if share else math.nan
            bar.begin(f"{text}, {remaining(left)}", 100, round(100 * share))

        def show_score(comparison: ModelComparison) -> None:
            so_far.append(comparison)
            echo(comparison.line(comparison.scores[-1]), err=True)

        interrupted = False
        try:
            compare_models(data, chosen, parts, show_progress, show_score)
        except KeyboardInterrupt:
            interrupted = True
    if so_far:
        output_console().print(rich_table(so_far[-1].table()))
        echo(so_far[-1].sentence())
    if interrupted:
        echo("interrupted: kinds that are not in the table were not compared", err=True)
        raise typer.Exit(_INTERRUPTED)


def remaining(seconds: float) -> str:
    """A time that is left [s] in words; NaN where it is not known."""
    if not math.isfinite(seconds):
        return "time left not known yet"
    return f"about {seconds:.0f} s left" if seconds < _TWO_MINUTES else f"about {seconds / 60:.0f} min left"
