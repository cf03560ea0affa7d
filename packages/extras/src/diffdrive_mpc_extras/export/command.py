"""`diffdrive-mpc export`: the controller as a C99 library for a microcontroller."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from diffdrive_mpc.app.command_line.options import PluggedCommand, out_option
from diffdrive_mpc.app.commands.options import ConfigFile, Model, Settings


def export(
    *,
    out: Annotated[Path, out_option("the library")],
    model: Model = None,
    config: ConfigFile = None,
    settings: Settings = None,
    trajectory: Annotated[
        str,
        typer.Option(help="What the table holds: a shipped name such as circle, or the path of a file."),
    ] = "circle",
    precision: Annotated[str, typer.Option(help="Number type: double or float.")] = "double",
    emulated: Annotated[
        bool, typer.Option("--emulate", help="Drive it on QEMU's STM32F4, and count the instructions of each step.")
    ] = False,
) -> None:
    """Write estimator, prediction, QP and failure ladder as C99 without allocation, and print their sizes."""
    from diffdrive_mpc_extras.export.report import export_library  # noqa: PLC0415 - --help does without it

    export_library(
        out,
        model=model,
        config=config,
        settings=settings or [],
        trajectory=trajectory,
        precision=precision,
        emulated=emulated,
    )


EXPORT = PluggedCommand(
    "Robot",
    export,
    "Example: diffdrive-mpc export --model ssm --set horizon=15 --precision float --out firmware",
)
