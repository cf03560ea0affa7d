"""`diffdrive-mpc campaign`: many runs drawn from distributions."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from diffdrive_mpc.bench.command_line.one_line_errors import FAILED
from diffdrive_mpc.bench.command_line.study_options import Jobs, out_option

EXAMPLE = "Example: diffdrive-mpc campaign floors.yaml --out floors --runs 64"
Scheduler = Annotated[
    str, typer.Option(metavar="tcp://HOST:PORT", help="Drive on the workers of a Dask scheduler.", show_default=False)
]
Runs = Annotated[int | None, typer.Option(min=1, help="How many runs.", show_default="what the file says")]


def campaign(
    file: Annotated[Path, typer.Argument(help="Campaign (YAML).", show_default=False)],
    *,
    out: Annotated[Path, out_option("results.parquet and the rows of the runs")],
    runs: Runs = None,
    part: Annotated[
        str | None, typer.Option(metavar="K/N", help="Every N-th run from the K-th on.", show_default="all of them")
    ] = None,
    jobs: Jobs = None,
    scheduler: Scheduler = "",
) -> None:
    """Drive many runs that a file draws; what was driven before is not driven again.

    The exit code is 1 when a run ended in an error; its row says which.
    """
    from diffdrive_mpc.app.campaign_command import Part, run_campaign  # noqa: PLC0415 - --help does without it
    from diffdrive_mpc.bench.campaign.engine import Place, failed  # noqa: PLC0415

    driven = run_campaign(file, Place(out, jobs, scheduler), runs, None if part is None else Part.read(part))
    if failed(driven):
        raise typer.Exit(FAILED)
