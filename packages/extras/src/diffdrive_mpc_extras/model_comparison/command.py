"""`diffdrive-mpc models compare`: every kind of model from one log, cross-validated."""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import Annotated

import typer

from diffdrive_mpc.app.command_line.echo import echo
from diffdrive_mpc.app.command_line.one_line_errors import INTERRUPTED
from diffdrive_mpc.app.command_line.options import PluggedCommand
from diffdrive_mpc.app.commands.options import Mapping

_TWO_MINUTES = 120.0


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
    """Identify every kind of model from a log, cross-validated, and select the one that it supports."""
    from diffdrive_mpc.bench.progress import ProgressBar, output_console  # noqa: PLC0415
    from diffdrive_mpc.bench.table import rich_table  # noqa: PLC0415
    from diffdrive_mpc.models.identification.log_data import read_data  # noqa: PLC0415
    from diffdrive_mpc.models.identification.settings import identification_settings  # noqa: PLC0415
    from diffdrive_mpc_extras.model_comparison.model_comparison import ModelComparison, compare_models  # noqa: PLC0415

    settings = identification_settings()
    with ProgressBar("comparison (minutes)", lines=True) as bar:
        data = read_data(
            logs,
            [],
            mapping=mapping,
            fit_share=settings.fit_share,
            wheels=False,
            on_findings=lambda _: None,
            max_rows=settings.max_rows["effects"],
        )
        chosen = tuple(name.strip() for name in kinds.split(",")) if kinds else ()
        begun, so_far = time.monotonic(), list[ModelComparison]()

        def show_progress(text: str, share: float) -> None:
            left = (time.monotonic() - begun) * (1.0 - share) / share if share else math.nan
            bar.start_stage(f"{text}, {remaining(left)}", 100, round(100 * share))

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
        raise typer.Exit(INTERRUPTED)


def remaining(seconds: float) -> str:
    """Format the remaining time [s] in words; NaN if it is unknown."""
    if not math.isfinite(seconds):
        return "time left not known yet"
    return f"about {seconds:.0f} s left" if seconds < _TWO_MINUTES else f"about {seconds / 60:.0f} min left"


COMPARE = PluggedCommand("Commands", compare, "Example: diffdrive-mpc models compare drive.csv --mapping mine.yaml")
