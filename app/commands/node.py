"""`diffdrive-mpc node`: drive a robot through ROS 2. This module imports nothing from `sim` or `bench`."""

from __future__ import annotations

from typing import Annotated

import typer

from diffdrive_mpc.app.commands.options import Settings, ros_arguments

NODE_EXAMPLE = "Example: diffdrive-mpc node --config my_robot.yaml --drive --ros-args -r cmd_vel:=/base/cmd_vel"


def node(
    context: typer.Context,
    *,
    config: Annotated[
        str,
        typer.Option(
            help="mbm, sm, ssm, two_delays, lstm, p2_experimental, p2_physical, kinematic, "
            "or a configuration file, for example the file used in simulation."
        ),
    ] = "ssm",
    trajectory: Annotated[
        str, typer.Option(help="a built-in name such as circle, or a file; if empty, references are received by topic.")
    ] = "circle",
    settings: Settings = None,
    autostart: Annotated[bool, typer.Option("--autostart", help="Configure and activate at start-up.")] = False,
    drive: Annotated[
        bool, typer.Option("--drive", help="Activate, and drive once measurements arrive; keep clear of the robot.")
    ] = False,
) -> None:
    """Drive a robot through ROS 2 until interrupted.

    Arguments after `--ros-args` are passed to ROS, for example remappings and parameters.
    """
    from diffdrive_mpc.mpc.config.typed_settings import parse_single_settings  # noqa: PLC0415 - --help does not need it
    from diffdrive_mpc.mpc.ros.settings import NodeSettings  # noqa: PLC0415
    from diffdrive_mpc.mpc.trajectories.load import trajectory_file  # noqa: PLC0415

    arguments = ros_arguments(context)
    node_settings = NodeSettings(
        config=config, trajectory=trajectory, autostart=autostart or drive, drive_on_activate=drive
    )
    overrides = parse_single_settings(settings or [])
    if trajectory and not trajectory.startswith("spline-"):
        trajectory_file(trajectory)
    from diffdrive_mpc.mpc.ros.main import run  # noqa: PLC0415 - needs rclpy

    run(arguments, node_settings, dict(overrides))
