"""`diffdrive-mpc tune`: a search over the configuration of a controller, and a verdict on other seeds."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from diffdrive_mpc.app.commands.campaign import Scheduler
from diffdrive_mpc.bench.command_line.completion import choices
from diffdrive_mpc.bench.command_line.study_options import Jobs, file_option, out_option

EXAMPLE = "Example: diffdrive-mpc tune ssm --out tuned"


def tune(
    config: Annotated[
        str,
        typer.Argument(help="Configuration: the path of a file, or mbm, sm, ssm.", autocompletion=choices("config")),
    ],
    *,
    out: Annotated[Path, out_option("config.yaml, tune.md, figures/, the study and the rows of its runs")],
    plan: Annotated[Path | None, file_option("Plan", "--plan")] = None,
    plant: Annotated[
        str | None,
        typer.Option(help="mujoco:ROBOT, model:NAME, or the file of a twin.", show_default="what the plan says"),
    ] = None,
    points: Annotated[
        int | None, typer.Option(min=2, help="How many to try.", show_default="what the plan says")
    ] = None,
    jobs: Jobs = None,
    scheduler: Scheduler = "",
    storage: Annotated[
        str, typer.Option(metavar="URL", help="Data base of the study in place of a file in --out.", show_default=False)
    ] = "",
    worker: Annotated[int, typer.Option(min=1, help="Number of this worker, where several share a study.")] = 1,
) -> None:
    """Search for weights, horizon, noises and limits on a plant and its neighbours; judge them on other seeds.

    What was interrupted goes on. Where nothing better is found, config.yaml holds the defaults, and the report says so.
    """
    from diffdrive_mpc.app.tune.study import tune as tuned  # noqa: PLC0415 - --help does without it

    result = tuned(
        config,
        out,
        plan=plan,
        plant=plant,
        points=points,
        workers=jobs,
        scheduler=scheduler,
        storage=storage,
        worker=worker,
    )
    typer.echo(f"{result.sentence}; configuration in {result.config_path}")
