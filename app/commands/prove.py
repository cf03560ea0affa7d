"""`diffdrive-mpc prove`: how often a controller fails, and where it stops to hold."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from diffdrive_mpc.app.commands.campaign import Runs, Scheduler
from diffdrive_mpc.bench.command_line.completion import choices
from diffdrive_mpc.bench.command_line.one_line_errors import FAILED
from diffdrive_mpc.bench.command_line.study_options import Jobs, out_option

EXAMPLE = "Example: diffdrive-mpc prove ssm --out proof --runs 40"


def prove(
    config: Annotated[
        str,
        typer.Argument(help="Configuration: the path of a file, or mbm, sm, ssm.", autocompletion=choices("config")),
    ],
    *,
    out: Annotated[Path, out_option("prove.md, prove.parquet, figures/, worst/ and the rows of the runs")],
    campaign: Annotated[
        Path | None,
        typer.Option(
            "--campaign",
            help="Campaign with maps and boundaries (YAML), or market: robots drawn as wide as sold.",
            show_default=False,
        ),
    ] = None,
    runs: Runs = None,
    worst: Annotated[int, typer.Option(min=0, max=99, help="Worst runs to keep as files.")] = 10,
    jobs: Jobs = None,
    scheduler: Scheduler = "",
) -> None:
    """Drive a controller on many plants, paths and faults: rates with intervals, maps, boundaries, worst runs.

    The exit code is 1 when a command was unsafe or a run ended in an error; the report is written all the same.
    """
    from diffdrive_mpc.app.proof.proof_file import load_proof  # noqa: PLC0415
    from diffdrive_mpc.app.proof.report import is_unsafe  # noqa: PLC0415
    from diffdrive_mpc.app.proof.study import ProofStudy, keep  # noqa: PLC0415
    from diffdrive_mpc.bench.campaign.engine import Place, failed  # noqa: PLC0415 - --help does without it
    from diffdrive_mpc.bench.study import carry_out  # noqa: PLC0415

    study = ProofStudy(config, load_proof(campaign), Place(out, jobs, scheduler), runs, worst)
    proven = carry_out(study, out, jobs)
    keep(proven, out)
    unsafe = sum(map(is_unsafe, proven.driven))
    complaint = f"{unsafe} runs had an unsafe command" if unsafe else failed(proven.driven)
    if complaint:
        typer.echo(f"error: {complaint}", err=True)
        raise typer.Exit(FAILED)
