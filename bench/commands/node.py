"""`diffdrive-mpc node`: the controller as a ROS 2 node."""

from __future__ import annotations

from typing import Annotated

import typer

from diffdrive_mpc.bench.commands.ros_arguments import ros_arguments

EXAMPLE = "Example: diffdrive-mpc node --config my_robot.yaml --drive --ros-args -r cmd_vel:=/base/cmd_vel"


def node(
    context: typer.Context,
    *,
    config: Annotated[
        str, typer.Option(help="mbm, sm, ssm, or the configuration file that was simulated with.")
    ] = "ssm",
    trajectory: Annotated[
        str, typer.Option(help="circle, square, s, cane, or the path of a file; empty: references come by topic.")
    ] = "circle",
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Replace a configuration value; repeatable."),
    ] = None,
    autostart: Annotated[bool, typer.Option("--autostart", help="Configure and activate at start-up.")] = False,
    drive: Annotated[
        bool, typer.Option("--drive", help="The same, and drive as soon as measurements arrive: stand clear.")
    ] = False,
) -> None:
    """Drive a robot through ROS 2, until interrupted. What follows `--ros-args` goes to ROS: remappings, parameters."""
    from diffdrive_mpc.bench.sweep import single_settings  # noqa: PLC0415 - --help does without it
    from diffdrive_mpc.mpc.ros.settings import NodeSettings  # noqa: PLC0415

    arguments = ros_arguments(context)
    own = NodeSettings(config=config, trajectory=trajectory, autostart=autostart or drive, drive_on_activate=drive)
    overrides = single_settings(settings or [])
    from diffdrive_mpc.mpc.ros.main import run  # noqa: PLC0415 - needs rclpy

    run(arguments, own, dict(overrides))
