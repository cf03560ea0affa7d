"""`python -m studies real-logs`: what the effects of a base are worth on a log of a real robot."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from diffdrive_mpc.bench.command_line.study_options import out_folder

EXAMPLE = "Example: python -m studies real-logs husky --data logs --out husky"


def real_logs(
    log: Annotated[str, typer.Argument(help="husky, warthog-asphalt or warthog-gravel.")],
    *,
    data: Annotated[Path, typer.Option(envvar="DIFFDRIVE_MPC_DATA", help="Folder with the logs.", show_default=False)],
    out: Annotated[
        Path,
        typer.Option(
            parser=out_folder, metavar="PATH", help="Folder for proof.md, model.yaml, config.yaml and surface.yaml."
        ),
    ],
    seeds: Annotated[int, typer.Option(min=0, help="Closed-loop runs of each kind; 0 for none.")] = 3,
) -> None:
    """Identify a real robot with the effects of its base, score it on held-out rows, and drive its stand-in."""
    from studies.real_logs.study import prove_log  # noqa: PLC0415 - --help and other commands do without it

    prove_log(log, data, out, seeds)
