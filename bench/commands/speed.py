"""`diffdrive-mpc speed`: how long a step takes, beside other solvers of the same problem."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from diffdrive_mpc.bench.commands.options import split_names, split_numbers
from diffdrive_mpc.bench.commands.out_folder import out_folder

EXAMPLE = "Example: diffdrive-mpc speed --out results --quick --peers ours,acados"


def speed(
    *,
    out: Annotated[
        Path, typer.Option(parser=out_folder, metavar="PATH", help="Folder for speed.json, speed.md and figures/.")
    ],
    quick: Annotated[bool, typer.Option("--quick", help="One model, two horizons, a short drive.")] = False,
    peers: Annotated[
        str | None,
        typer.Option(metavar="NAMES", help="Subjects; `ours` and `casadi` are groups.", show_default="all of them"),
    ] = None,
    models: Annotated[str | None, typer.Option(metavar="NAMES", help="Models.", show_default="mbm,sm,ssm")] = None,
    horizons: Annotated[
        str | None, typer.Option(metavar="NUMBERS", help="Horizons.", show_default="10,20,30,50,100")
    ] = None,
    settings: Annotated[
        Path | None, typer.Option(help="Settings (YAML) in place of the shipped ones.", show_default=False)
    ] = None,
    environment: Annotated[
        Path | None,
        typer.Option(
            help="Folder of the peers' own environment; made there if it is not.",
            show_default="in the user's cache folder",
        ),
    ] = None,
) -> None:
    """Time whole steps of the controller and of its peers on the same problem: about a quarter of an hour."""
    from diffdrive_mpc.bench.speed.command import run_speed  # noqa: PLC0415 - --help and other commands do without it
    from diffdrive_mpc.bench.speed.settings import chosen, load_speed_settings  # noqa: PLC0415

    loaded = load_speed_settings(settings, quick=quick)
    changes: dict[str, object] = {}
    if models is not None:
        changes["models"] = split_names(models, "--models")
    if horizons is not None:
        changes["horizons"] = split_numbers(horizons, "--horizons", least=1)
    names = None if peers is None else split_names(peers, "--peers")
    run_speed(chosen(loaded.model_copy(update=changes), names), out, environment)
