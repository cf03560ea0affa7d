"""`diffdrive-mpc log`: logs in other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from diffdrive_mpc.app.command_line.echo import echo
from diffdrive_mpc.app.command_line.options import out_option

log_app = typer.Typer(no_args_is_help=True, help="Open logs in Foxglove, PlotJuggler and Rerun.")


@log_app.command(epilog="Example: diffdrive-mpc log layouts --out layouts")
def layouts(out: Annotated[Path, out_option("foxglove.json and plotjuggler.xml")]) -> None:
    """Write the layouts for Foxglove and PlotJuggler that fit the topics of a log."""
    from diffdrive_mpc.app.layouts import write_layouts  # noqa: PLC0415 - --help does without it

    for path in write_layouts(out):
        echo(path)


@log_app.command(epilog="Example: diffdrive-mpc log rerun drive.mcap --to drive.rrd")
def rerun(
    file: Annotated[Path, typer.Argument(metavar="LOG", help="A log of `simulate` or of the node, .mcap or .csv.")],
    to: Annotated[str, typer.Option(metavar="live|FILE.rrd", help="Open the viewer, or write a file for it.")] = "live",
) -> None:
    """Show a log in Rerun: robot, plan and reference, and the numbers over time. Needs the extra `rerun`."""
    from diffdrive_mpc.app.rerun_view import show_log  # noqa: PLC0415 - --help does without it

    echo(f"{file}: {show_log(file, to)} ticks" + (f", {to}" if to != "live" else ""))
