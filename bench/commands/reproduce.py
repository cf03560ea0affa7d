"""`diffdrive-mpc reproduce`: the papers' experiments on the simulated robot, beside the papers' figures."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from diffdrive_mpc.bench.commands.options import split_names
from diffdrive_mpc.bench.commands.out_folder import out_folder

EXAMPLE = "Example: diffdrive-mpc reproduce --out results --only virtual_track"


def reproduce(
    *,
    out: Annotated[
        Path,
        typer.Option(parser=out_folder, metavar="PATH", help="Folder for reproduce.json, reproduce.md and figures/."),
    ],
    quick: Annotated[bool, typer.Option("--quick", help="A small study of under a minute.")] = False,
    only: Annotated[
        str | None,
        typer.Option(metavar="PARTS", help="mbm_sm, ssm, cost, virtual_track.", show_default="all of them"),
    ] = None,
    jobs: Annotated[int | None, typer.Option(min=1, help="Processes.", show_default="one for each core")] = None,
) -> None:
    """Repeat the papers' experiments on the simulated robot and say which findings hold: minutes on two cores."""
    from diffdrive_mpc.bench.reproduce.command import repeat  # noqa: PLC0415 - --help and other commands do without it
    from diffdrive_mpc.bench.reproduce.study import PARTS, load_study  # noqa: PLC0415

    repeat(load_study(quick=quick), out, PARTS if only is None else split_names(only, "--only"), jobs)
