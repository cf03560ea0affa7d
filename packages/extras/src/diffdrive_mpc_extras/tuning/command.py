"""`diffdrive-mpc tune`: search over the configuration of a controller, and comparison on other seeds."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from diffdrive_mpc.app.command_line.echo import echo
from diffdrive_mpc.app.command_line.options import Jobs, PluggedCommand, file_option, out_option


def tune(
    config: Annotated[
        str,
        typer.Argument(help="Configuration: the path of a file, or mbm, sm, ssm."),
    ],
    *,
    out: Annotated[Path, out_option("config.yaml, tune.md and figures/")],
    plan: Annotated[Path | None, file_option("Plan", "--plan")] = None,
    plant: Annotated[
        str | None,
        typer.Option(help="mujoco:ROBOT, model:NAME, or the file of a robot or twin.", show_default="from the plan"),
    ] = None,
    points: Annotated[
        int | None, typer.Option(min=2, help="Number of configurations.", show_default="from the plan")
    ] = None,
    jobs: Jobs = None,
) -> None:
    """Search for weights, horizon, noises and limits with a small position error, and compare on other seeds.

    If no point is better on these seeds, config.yaml contains the start configuration, and the report states it.
    """
    from diffdrive_mpc_extras.tuning.study import tune as run_tuning  # noqa: PLC0415 - --help does not need it

    result = run_tuning(config, out, plan=plan, plant=plant, points=points, jobs=jobs)
    echo(f"{result.sentence}; configuration in {result.config_path}")


TUNE = PluggedCommand("Your robot", tune, "Example: diffdrive-mpc tune ssm --out tuned")
