"""Command `diffdrive-mpc prove`: failure rates of a controller, and the limits of its conditions."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from diffdrive_mpc.app.command_line.echo import echo
from diffdrive_mpc.app.command_line.one_line_errors import FAILED
from diffdrive_mpc.app.command_line.options import Jobs, PluggedCommand, out_option
from diffdrive_mpc_extras.campaign.command import Runs


def prove(
    config: Annotated[
        str,
        typer.Argument(help="Configuration: the path of a file, or mbm, sm, ssm."),
    ],
    *,
    out: Annotated[Path, out_option("prove.md, prove.parquet, figures/, worst/ and the rows of the runs")],
    campaign: Annotated[
        Path | None,
        typer.Option(
            "--campaign",
            help="Campaign with maps and boundaries (YAML), or market: drawn robots of the population on sale.",
            show_default=False,
        ),
    ] = None,
    plant: Annotated[
        str | None,
        typer.Option(
            help="Simulated robot, as for simulate.",
            show_default="that of the campaign; else twin or identified robot in the folder of the configuration",
        ),
    ] = None,
    runs: Runs = None,
    worst: Annotated[int, typer.Option(min=0, max=99, help="Number of worst runs to keep as files.")] = 10,
    tolerance: Annotated[
        str,
        typer.Option(
            metavar="M,M,...",
            help="Measure only a speed passport: the maximum speeds within these lateral errors [m].",
            show_default=False,
        ),
    ] = "",
    jobs: Jobs = None,
) -> None:
    """Drive a controller on many plants, paths and faults: rates with intervals, maps, boundaries, worst runs.

    The exit code is 1 if a command was unsafe or a run ended in an error; the report is written in all cases.
    """
    from diffdrive_mpc.bench.study import carry_out  # noqa: PLC0415 - --help does not need it
    from diffdrive_mpc_extras.campaign.engine import CampaignPlace, describe_errors  # noqa: PLC0415
    from diffdrive_mpc_extras.proof.proof_file import proof_of  # noqa: PLC0415
    from diffdrive_mpc_extras.proof.report import is_unsafe  # noqa: PLC0415
    from diffdrive_mpc_extras.proof.study import ProofStudy, write_proof  # noqa: PLC0415

    proof, place = proof_of(config, campaign, plant), CampaignPlace(out, jobs)
    if tolerance:
        from diffdrive_mpc_extras.proof.passport import PassportStudy, read_tolerances  # noqa: PLC0415

        measured = carry_out(PassportStudy(config, proof, place, read_tolerances(tolerance)), out, jobs)
        if problem := describe_errors(measured.driven):
            echo(f"error: {problem}", err=True)
            raise typer.Exit(FAILED)
        return
    proven = carry_out(ProofStudy(config, proof, place, runs, worst), out, jobs)
    write_proof(proven, out)
    unsafe = sum(map(is_unsafe, proven.driven))
    problem = f"{unsafe} runs had an unsafe command" if unsafe else describe_errors(proven.driven)
    if problem:
        echo(f"error: {problem}", err=True)
        raise typer.Exit(FAILED)


PROVE = PluggedCommand("Your robot", prove, "Example: diffdrive-mpc prove ssm --out proof --runs 40")
