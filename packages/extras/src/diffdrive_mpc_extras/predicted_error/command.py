"""`diffdrive-mpc predict-error`: predict the tracking error of a trajectory before the drive."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from diffdrive_mpc.app.command_line.options import Jobs, PluggedCommand, out_option


def predict_error(
    *,
    config: Annotated[
        str,
        typer.Option(help="Configuration: path of a file, or mbm, sm, ssm."),
    ] = "ssm",
    trajectory: Annotated[str, typer.Option(help="Name or path of the trajectory.")],
    plant: Annotated[
        str | None,
        typer.Option(
            help="Simulated plant, as for simulate.",
            show_default="twin or identified robot next to the configuration",
        ),
    ] = None,
    draws: Annotated[int, typer.Option(min=20, help="Number of simulated drives.")] = 60,
    learn_from: Annotated[
        list[Path] | None,
        typer.Option(metavar="LOG", help="MCAP logs of at least 19 drives of the robot, which scale the tubes."),
    ] = None,
    population: Annotated[
        str | None,
        typer.Option(metavar="drawn", help="Population of robots instead of the plant, for an unknown robot."),
    ] = None,
    calibration: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="With --population: calibration file."),
    ] = None,
    jobs: Jobs = None,
    out: Annotated[Path, out_option("predicted-error.png and predicted-error.csv")],
) -> None:
    """Predict the tracking error of a trajectory before the drive: tubes that contain 95 % of drives.

    The drives are simulated on the identified robot, including the residual motion that the model does not explain.
    """
    from diffdrive_mpc_extras.predicted_error import report  # noqa: PLC0415 - --help does not need it

    if population is None and calibration is None:
        report.predict_robot_into(config, trajectory, plant, out, draws, jobs, learn_from or ())
    else:
        report.predict_population_into(config, trajectory, population or "drawn", out, calibration)


PREDICT_ERROR = PluggedCommand(
    "Your robot",
    predict_error,
    "Example: diffdrive-mpc predict-error --config my_robot/config.yaml --trajectory s --out predicted",
)
