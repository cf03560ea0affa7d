"""`diffdrive-mpc export`: export the controller as a C99 library for a microcontroller."""

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
        typer.Option(help="Exported trajectory: a built-in name such as circle, or the path of a file."),
    ] = "circle",
    precision: Annotated[str, typer.Option(help="Floating-point type: double or float.")] = "double",
    run_emulation: Annotated[
        bool,
        typer.Option("--emulate", help="Run the controller on QEMU's STM32F4 and count the instructions per step."),
    ] = False,
) -> None:
    """Write estimator, prediction, QP solver and failure ladder as C99 without memory allocation; print the sizes."""
    from diffdrive_mpc_extras.export.report import export_library  # noqa: PLC0415 - --help does not need it

    export_library(
        out,
        model=model,
        config=config,
        settings=settings or [],
        trajectory=trajectory,
        precision=precision,
        run_emulation=run_emulation,
    )


EXPORT = PluggedCommand(
    "Robot",
    export,
    "Example: diffdrive-mpc export --model ssm --set horizon=15 --precision float --out firmware",
)
