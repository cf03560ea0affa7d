"""`diffdrive-mpc twin`: fit a simulated plant to logs of a robot."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from diffdrive_mpc.app.command_line.options import Jobs, PluggedCommand, out_option
from diffdrive_mpc.app.commands.options import Mapping


def twin(
    *,
    logs: Annotated[list[Path], typer.Argument(metavar="LOG...", help="CSV files or ROS 2 bags.")],
    out: Annotated[Path, out_option("plant.yaml, report.html, twin.json, twin.md and figures/")],
    mapping: Mapping = None,
    robot: Annotated[
        str | None,
        typer.Option(
            metavar="NAME|FILE",
            help="Known values of the robot (YAML): mass, wheel base, motors.",
            show_default="scaled from the track of the log",
        ),
    ] = None,
    model: Annotated[
        str | None,
        typer.Option(
            metavar="NAME|FILE",
            help="Identified linear model for the initial values and the comparison.",
            show_default="an SM, identified from the same rows",
        ),
    ] = None,
    effects: Annotated[
        bool, typer.Option("--effects", help="Identify effects of the base for that SM: slew, steps, veer; minutes.")
    ] = False,
    seconds: Annotated[float | None, typer.Option(help="Duration of the fitted data [s].", show_default="90")] = None,
    name: Annotated[str | None, typer.Option(help="Name of the robot.", show_default="from the logs")] = None,
    jobs: Jobs = None,
    force: Annotated[bool, typer.Option("--force", help="Continue although the logs have errors.")] = False,
) -> None:
    """Fit the MuJoCo plant to logs; write its parameters and a plant file for `simulate --plant mujoco:FILE`."""
    from diffdrive_mpc.bench.study import carry_out  # noqa: PLC0415 - --help does not need it
    from diffdrive_mpc_extras.twin.study import TwinStudy  # noqa: PLC0415

    options = {"mapping": mapping, "robot": robot, "model": model, "effects": effects}
    carry_out(TwinStudy(logs, **options, seconds=seconds, name=name, force=force), out, jobs)


TWIN = PluggedCommand("Your robot", twin, "Example: diffdrive-mpc twin drive.csv --robot my_robot.yaml --out my_twin")
