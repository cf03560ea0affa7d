"""`diffdrive-mpc predict-error`: the tracking error of a trajectory before it is driven."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from diffdrive_mpc.app.command_line.options import Jobs, PluggedCommand, out_option


def predict_error(
    *,
    config: Annotated[
        str,
        typer.Option(help="Configuration: the path of a file, or mbm, sm, ssm."),
    ] = "ssm",
    trajectory: Annotated[str, typer.Option(help="Name or path of the trajectory.")],
    plant: Annotated[
        str | None,
        typer.Option(
            help="Robot that is driven in simulation, as for simulate.",
            show_default="twin or identified robot in the folder of the configuration",
        ),
    ] = None,
    draws: Annotated[int, typer.Option(min=20, help="Simulated drives.")] = 60,
    learn_from: Annotated[
        list[Path] | None,
        typer.Option(metavar="LOG", help="MCAP log of a drive of the robot, 19 or more: they scale the tubes."),
    ] = None,
    population: Annotated[
        str | None,
        typer.Option(metavar="drawn", help="Any robot of the market instead, if nothing is known of yours."),
    ] = None,
    calibration: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="With --population: a calibration of your own."),
    ] = None,
    jobs: Jobs = None,
    out: Annotated[Path, out_option("predicted-error.png and predicted-error.csv")],
) -> None:
    """Predict the tracking error of a trajectory before it is driven: tubes in which 95 % of drives stay.

    Drives of the robot itself are simulated, with the motion that its model left unexplained in the log.
    """
    from diffdrive_mpc_extras.predicted_error import report  # noqa: PLC0415 - --help does without it

    if population is None and calibration is None:
        report.predict_robot_into(config, trajectory, plant, out, draws, jobs, learn_from or ())
    else:
        report.predict_population_into(config, trajectory, population or "drawn", out, calibration)


PREDICT_ERROR = PluggedCommand(
    "Your robot",
    predict_error,
    "Example: diffdrive-mpc predict-error --config my_robot/config.yaml --trajectory s --out predicted",
)
