"""`diffdrive-mpc models compare`: cross-validated comparison of model kinds on a log."""

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

_MINUTES_FROM = 120.0  # remaining time from which minutes are printed [s]


def compare(
    logs: Annotated[list[Path], typer.Argument(metavar="LOG...", help="CSV files or bags of one robot.")],
    mapping: Mapping = None,
    kinds: Annotated[
        str,
        typer.Option(
            metavar="LIST",
            help="Model kinds to compare, separated by commas, or all.",
            show_default="all but hybrid and lstm",
        ),
    ] = "",
    parts: Annotated[int, typer.Option(min=2, help="Number of parts of the log for the cross-validation.")] = 3,
) -> None:
    """Identify several kinds of model from a log, compare them by cross-validation, and recommend one."""
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
        names = tuple(name.strip() for name in kinds.split(",")) if kinds else ()
        start, comparisons = time.monotonic(), list[ModelComparison]()

        def show_progress(text: str, share: float) -> None:
            seconds = (time.monotonic() - start) * (1.0 - share) / share if share else math.nan
            bar.start_stage(f"{text}, {format_remaining(seconds)}", 100, round(100 * share))

        def show_score(comparison: ModelComparison) -> None:
            comparisons.append(comparison)
            echo(comparison.line(comparison.scores[-1]), err=True)

        is_interrupted = False
        try:
            compare_models(data, names, parts, show_progress, show_score)
        except KeyboardInterrupt:
            is_interrupted = True
    if comparisons:
        output_console().print(rich_table(comparisons[-1].table()))
        echo(comparisons[-1].sentence())
    if is_interrupted:
        echo("interrupted: the table lacks the kinds that were not finished", err=True)
        raise typer.Exit(INTERRUPTED)


def format_remaining(seconds: float) -> str:
    """Format the remaining time [s]; NaN if it is unknown."""
    if not math.isfinite(seconds):
        return "remaining time unknown"
    return f"about {seconds:.0f} s left" if seconds < _MINUTES_FROM else f"about {seconds / 60:.0f} min left"


COMPARE = PluggedCommand("Commands", compare, "Example: diffdrive-mpc models compare drive.csv --mapping mine.yaml")
