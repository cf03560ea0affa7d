"""`diffdrive-mpc identify`: from logs of a robot to a model that the controller loads, and how far to trust it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from diffdrive_mpc.bench.commands.options import out_folder

EXAMPLE = "Example: diffdrive-mpc identify drive.csv --model sm --out my_robot"


def identify(
    *,
    logs: Annotated[list[Path], typer.Argument(metavar="LOG...", help="CSV files or ROS 2 bags.")],
    model: Annotated[str, typer.Option(help="Structure of the model: mbm, sm or ssm.")] = "sm",
    mapping: Annotated[
        str | None,
        typer.Option(
            metavar="NAME|FILE",
            help="What the columns or topics are.",
            show_default="that of simulate --log, and a bag's usual topics",
        ),
    ] = None,
    out: Annotated[
        Path, typer.Option(parser=out_folder, metavar="PATH", help="Folder for model, configuration and report.")
    ] = Path("identified"),
    validate: Annotated[
        list[Path] | None,
        typer.Option(metavar="LOG", help="Log to try the model on; repeatable.", show_default="a share of each log"),
    ] = None,
    fit_share: Annotated[
        float | None,
        typer.Option(help="Share of each log to identify from; the rest scores it.", show_default="0.6"),
    ] = None,
    order: Annotated[str, typer.Option(metavar="auto|N", help="Order of an ssm, 1 to 5.")] = "auto",
    effects: Annotated[
        bool, typer.Option("--effects", help="Look for what the base does around an sm: slew, steps, tyres, veer.")
    ] = False,
    name: Annotated[str | None, typer.Option(help="Name of the model.", show_default="from the logs")] = None,
) -> None:
    """Identify a velocity model from logs; write it with a configuration, a report and figures."""
    from diffdrive_mpc.bench.identification.command import identify as run  # noqa: PLC0415 - --help and other commands do without it

    run(
        logs,
        model,
        validate=validate or [],
        mapping=mapping,
        fit_share=fit_share,
        order=order,
        effects=effects,
        name=name,
        out=out,
    )
