"""`diffdrive-mpc predict-error`: the tracking error of a trajectory before it is driven."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from diffdrive_mpc.app.command_line.options import PluggedCommand, out_option


def predict_error(
    *,
    config: Annotated[
        str,
        typer.Option(help="Configuration: the path of a file, or mbm, sm, ssm."),
    ] = "ssm",
    trajectory: Annotated[str, typer.Option(help="Name or path of the trajectory.")],
    population: Annotated[
        str, typer.Option(metavar="drawn|own", help="Any robot of the market, or the configuration's own.")
    ] = "drawn",
    calibration: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Calibration of your own robot's twin; else the shipped one.")
    ] = None,
    out: Annotated[Path, out_option("predicted-error.png and predicted-error.csv")],
) -> None:
    """Predict the tracking error of a trajectory before it is driven: tubes in which 95 % of drives stay, and why."""
    from diffdrive_mpc_extras.predicted_error.report import predict_into  # noqa: PLC0415 - --help does without it

    predict_into(config, trajectory, population, out, calibration)


PREDICT_ERROR = PluggedCommand(
    "Your robot",
    predict_error,
    "Example: diffdrive-mpc predict-error --config ssm --trajectory s --out predicted",
)
