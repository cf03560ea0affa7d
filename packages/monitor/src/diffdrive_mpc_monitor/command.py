"""Command `diffdrive-mpc monitor`: run the monitor of a controller, or export its code."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from diffdrive_mpc.app.command_line.echo import echo
from diffdrive_mpc.app.command_line.options import PluggedCommand
from diffdrive_mpc.app.commands.options import ros_arguments

RulesFile = Annotated[str, typer.Option(metavar="NAME|FILE", help="Rules: a shipped name, or the path of a YAML file.")]


def monitor(
    context: typer.Context,
    *,
    rules: RulesFile = "default",
    export: Annotated[
        Path | None,
        typer.Option(help="Write the judge in C with these rules into a folder instead.", show_default=False),
    ] = None,
) -> None:
    """Check commands between a controller and its base: pass them on, or stop the robot if a rule is violated.

    The controller has to publish `cmd_vel_unchecked` (node: `--ros-args -r cmd_vel:=cmd_vel_unchecked`). Arguments
    after `--ros-args` are passed to ROS: remappings, parameters.
    """
    arguments = ros_arguments(context)
    if export is not None:
        from diffdrive_mpc_monitor.export import export_judge  # noqa: PLC0415 - --help does not need it
        from diffdrive_mpc_monitor.rules import load_rules  # noqa: PLC0415

        echo("\n".join(str(path) for path in export_judge(load_rules(rules), export)))
        return
    from diffdrive_mpc_monitor.ros.node import MonitorSettings, run  # noqa: PLC0415 - needs ROS

    run(arguments, MonitorSettings(rules=rules))


MONITOR = PluggedCommand(
    "Robot",
    monitor,
    "Example: diffdrive-mpc monitor --ros-args -r cmd_vel:=/base/cmd_vel",
    passed_on=True,
)
