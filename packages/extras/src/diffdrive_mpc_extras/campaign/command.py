"""Commands `diffdrive-mpc campaign`, which simulates many runs, and `diffdrive-mpc repeat`, which repeats one run."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from diffdrive_mpc.app.command_line.one_line_errors import FAILED
from diffdrive_mpc.app.command_line.options import Jobs, PluggedCommand, out_option
from diffdrive_mpc.app.commands.options import TrustedFolders

Runs = Annotated[int | None, typer.Option(min=1, help="Number of runs.", show_default="that of the file")]


def campaign(
    file: Annotated[Path, typer.Argument(help="Campaign (YAML).", show_default=False)],
    *,
    out: Annotated[Path, out_option("results.parquet and the rows of the runs")],
    runs: Runs = None,
    part: Annotated[
        str | None, typer.Option(metavar="K/N", help="Every N-th run from the K-th on.", show_default="all runs")
    ] = None,
    jobs: Jobs = None,
) -> None:
    """Simulate the runs of a campaign file; stored runs are not repeated.

    The exit code is 1 if a run ended in an error; the row of the run contains the error.
    """
    from diffdrive_mpc_extras.campaign.engine import CampaignPlace, describe_errors  # noqa: PLC0415 - --help does not need it
    from diffdrive_mpc_extras.campaign.run import Part, run_campaign  # noqa: PLC0415

    results = run_campaign(file, CampaignPlace(out, jobs), runs, None if part is None else Part.read(part))
    if describe_errors(results):
        raise typer.Exit(FAILED)


def repeat(
    file: Annotated[
        Path, typer.Argument(metavar="RUN", help="Run file written by `prove` (YAML).", show_default=False)
    ],
    *,
    out: Annotated[Path | None, out_option("report.html and figures")] = None,
    log: Annotated[
        Path | None, typer.Option(help="File for the log of the run: .csv or .mcap.", show_default=False)
    ] = None,
    trust_terms: TrustedFolders = None,
    details: Annotated[bool, typer.Option("--details", help="Print the tables instead of the summary.")] = False,
) -> None:
    """Repeat the run of a file and compare its values with the file.

    The exit code is 1 if a value differs.
    """
    from diffdrive_mpc_extras.campaign.repeat import repeat_run  # noqa: PLC0415 - --help does not need it

    if not repeat_run(file, out, log, trust_terms or (), details=details):
        raise typer.Exit(FAILED)


CAMPAIGN = PluggedCommand("Drive", campaign, "Example: diffdrive-mpc campaign floors.yaml --out floors --runs 64")
REPEAT = PluggedCommand("Drive", repeat, "Example: diffdrive-mpc repeat proof/worst/01.yaml --out worst-run")
