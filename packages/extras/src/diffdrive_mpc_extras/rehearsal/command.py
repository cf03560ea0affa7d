"""Command `diffdrive-mpc rehearse`: laps of one case, with and without rehearsal."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from diffdrive_mpc.app.command_line.options import PluggedCommand, out_option
from diffdrive_mpc.app.commands.options import ConfigFile, Scaled, Settings, with_dimensions


@with_dimensions("model", "trajectory", "timing", "plant", "surface", "sensors", "scenario", "seed")
def rehearse(
    *,
    laps: Annotated[int, typer.Option(min=2, max=1000, help="Number of laps.")] = 5,
    config: ConfigFile = None,
    settings: Settings = None,
    out: Annotated[Path, out_option("report.html, rehearse.json, rehearse.md and figures/")],
    log: Annotated[
        Path | None, typer.Option(help="File for the log of the last lap: .csv or .mcap.", show_default=False)
    ] = None,
    scale_to_robot: Scaled = False,
    **values: Any,  # noqa: ANN401 - text or number
) -> None:
    """Drive laps along one trajectory, learn from lap to lap, and compare with laps without rehearsal."""
    from diffdrive_mpc.app.simulate.single import case_from_options  # noqa: PLC0415 - --help does not need it
    from diffdrive_mpc.bench.study import carry_out  # noqa: PLC0415
    from diffdrive_mpc_extras.rehearsal.laps import LapsStudy  # noqa: PLC0415

    values["controller"] = "mpc"
    case = case_from_options(values, config=config, settings=settings or [], scaled=scale_to_robot)
    carry_out(LapsStudy(case, laps, log), out, jobs=1)


REHEARSE = PluggedCommand("Drive", rehearse, "Example: diffdrive-mpc rehearse --laps 5 --trajectory s --out laps")
