"""`diffdrive-mpc tracking`: what was asked of the tracking, what each part is worth, and how much is left."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from diffdrive_mpc.bench.commands.options import split_names
from diffdrive_mpc.bench.commands.out_folder import out_folder

EXAMPLE = "Example: diffdrive-mpc tracking --out results --quick --only cross,bound"


def tracking(
    *,
    out: Annotated[
        Path,
        typer.Option(parser=out_folder, metavar="PATH", help="Folder for tracking.json, tracking.md and figures/."),
    ],
    quick: Annotated[bool, typer.Option("--quick", help="A small study of under a minute.")] = False,
    study: Annotated[
        Path | None, typer.Option(help="Study file (YAML) in place of the shipped one.", show_default=False)
    ] = None,
    only: Annotated[
        str | None,
        typer.Option(
            metavar="PARTS", help="targets, ablation, cross, surfaces, scenarios, bound.", show_default="all of them"
        ),
    ] = None,
    jobs: Annotated[int | None, typer.Option(min=1, help="Processes.", show_default="one for each core")] = None,
) -> None:
    """Run the tracking study and write its tables and figures: about ten minutes on two cores."""
    from diffdrive_mpc.bench.tracking.command import track  # noqa: PLC0415 - --help and other commands do without it
    from diffdrive_mpc.bench.tracking.study import PARTS, load_study  # noqa: PLC0415

    if quick and study is not None:
        raise ValueError(f"--study {study}: --quick has a study of its own; give one of them")
    parts = PARTS if only is None else split_names(only, "--only")
    track(load_study(study, quick=quick), out, parts, jobs)
