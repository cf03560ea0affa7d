"""`diffdrive-mpc bench`: compare models on trajectories and write the report."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from diffdrive_mpc.bench.commands.one_line_errors import FAILED
from diffdrive_mpc.bench.commands.options import ConfigFile
from diffdrive_mpc.bench.commands.out_folder import out_folder

EXAMPLE = "Example: diffdrive-mpc bench --out results --models ssm --set weights.across=60,120,240"


def bench(
    *,
    out: Annotated[
        Path, typer.Option(parser=out_folder, metavar="PATH", help="Folder for bench.json, bench.md and figures/.")
    ],
    models: Annotated[
        str | None, typer.Option(help="Velocity models: names or paths.", show_default="mbm,sm,ssm, or --config's")
    ] = None,
    trajectories: Annotated[
        str | None, typer.Option(help="Trajectories: names or paths.", show_default="circle,square,s,cane")
    ] = None,
    seeds: Annotated[
        str | None, typer.Option(metavar="N|LIST", help="How many seeds, or a list of them.", show_default="5")
    ] = None,
    controllers: Annotated[str | None, typer.Option("--controller", help="mpc,kanayama", show_default="mpc")] = None,
    plants: Annotated[
        str | None, typer.Option("--plant", help="mujoco, model:NAME, model:NAME+DEAD_TIME.", show_default="mujoco")
    ] = None,
    surfaces: Annotated[
        str | None,
        typer.Option(
            "--surface", help="Surfaces: floor of the mujoco plant, slip of model: plants.", show_default="default"
        ),
    ] = None,
    sensors: Annotated[str | None, typer.Option(help="Sensor sets.", show_default="default")] = None,
    scenarios: Annotated[
        str | None,
        typer.Option("--scenario", help="Scenarios: names or paths of disturbances.", show_default="none"),
    ] = None,
    config: ConfigFile = None,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=V1,V2,...", help="Sweep a configuration value; repeatable."),
    ] = None,
    horizons: Annotated[
        str | None,
        typer.Option(
            metavar="LIST|none",
            help="Horizons to sweep in steps.",
            show_default="5,10,15,20,30,50; none with --set, --scenario or --quick",
        ),
    ] = None,
    jobs: Annotated[int | None, typer.Option(min=1, help="Processes.", show_default="one for each core")] = None,
    quick: Annotated[bool, typer.Option("--quick", help="One seed and no horizon sweep.")] = False,
) -> None:
    """Compare controllers on trajectories. Options that name several things take them with commas between.

    The exit code is 1 when a run of the predictive controller did not complete; the report is written all the same.
    """
    from diffdrive_mpc.bench.compare import Choices, compare, incomplete  # noqa: PLC0415 - --help and other commands do without it

    choices = Choices(
        controllers,
        models,
        trajectories,
        seeds,
        plants,
        surfaces,
        sensors,
        horizons,
        config,
        settings or [],
        quick,
        scenarios,
    )
    complaint = incomplete(compare(choices, out, jobs))
    if complaint:
        typer.echo(f"error: {complaint}", err=True)
        raise typer.Exit(FAILED)
