"""`python -m studies worlds`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from diffdrive_mpc.app.command_line.options import Jobs, out_option
from diffdrive_mpc.bench.case import split_names

EXAMPLE = "Example: python -m studies worlds --out results --quick --controllers mpc,rpp+stop"
_QUICK_RUNS = 2


def run(
    *,
    out: Annotated[Path, out_option("report.html, worlds.json and worlds.md")],
    quick: Annotated[bool, typer.Option("--quick", help="Two runs of each part.")] = False,
    only: Annotated[str, typer.Option(metavar="PARTS", help="Parts.")] = "drawn,doorway,crossing,named",
    controllers: Annotated[str, typer.Option(metavar="NAMES", help="mpc, or peers.")] = "mpc,mppi+grid,rpp+stop",
    model: Annotated[str, typer.Option(metavar="NAME", help="Model of mpc.")] = "ssm",
    runs: Annotated[int | None, typer.Option(min=1, help="Drawn worlds, and crossings.", show_default="1000")] = None,
    seed: Annotated[int, typer.Option(min=0, help="First seed.")] = 0,
    jobs: Jobs = None,
) -> None:
    """Drive through drawn and named worlds, count contacts, and compare with peers that see the same: hours in full."""
    from studies.worlds.settings import PARTS, load_settings  # noqa: PLC0415
    from studies.worlds.study import WorldsStudy  # noqa: PLC0415

    from diffdrive_mpc.bench.study import carry_out, check_parts  # noqa: PLC0415 - --help does not need it

    parts, names = split_names(only, "--only"), split_names(controllers, "--controllers")
    check_parts(parts, PARTS)
    counts = dict.fromkeys(PARTS, _QUICK_RUNS) if quick else {}
    counts |= {} if runs is None else {"drawn": runs, "crossing": runs}
    carry_out(WorldsStudy(load_settings(), parts, controllers=names, model=model, runs=counts, first=seed), out, jobs)
