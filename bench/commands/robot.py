"""`diffdrive-mpc robot`: the simulated robot as a ROS 2 node."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from diffdrive_mpc.bench.commands.ros_arguments import ros_arguments

EXAMPLE = "Example: diffdrive-mpc robot --trajectory s --lock-step --record out/drive"


def robot(
    context: typer.Context,
    *,
    trajectory: Annotated[str, typer.Option(help="Start at the beginning of this trajectory: a name or a path.")] = (
        "circle"
    ),
    plant: Annotated[str, typer.Option(help="mujoco, model:NAME, or model:NAME+DEAD_TIME.")] = "mujoco",
    surface: Annotated[str, typer.Option(help="Floor of the mujoco plant, slip of a model: plant.")] = "default",
    sensors: Annotated[str, typer.Option(help="Sensor set.")] = "default",
    scenario: Annotated[
        str, typer.Option(help="What happens to the robot: none, push, ..., or the path of a file.")
    ] = "none",
    seed: Annotated[int, typer.Option(min=0, help="Seed of the noise.")] = 0,
    lock_step: Annotated[
        bool, typer.Option("--lock-step/--real-time", help="Publish /clock and wait for the command to each tick.")
    ] = False,
    duration: Annotated[
        float | None, typer.Option(help="End after so many seconds on the robot's clock.", show_default="go on")
    ] = None,
    base: Annotated[
        Path | None, typer.Option(help="Base settings (YAML): rates, timeouts.", show_default="shipped")
    ] = None,
    stamped: Annotated[
        bool | None,
        typer.Option("--stamped/--unstamped", help="Commands are TwistStamped or Twist.", show_default="as --base"),
    ] = None,
    command_timeout: Annotated[
        float | None, typer.Option(help="Stop after so many seconds without a command.", show_default="as --base")
    ] = None,
    answer_timeout: Annotated[
        float | None,
        typer.Option(
            help="In lock step: longest wait for the command to a tick, in seconds.", show_default="as --base"
        ),
    ] = None,
    odometry_pose: Annotated[
        Literal["dead_reckoning", "pose_sensor"] | None,
        typer.Option(help="Where the pose in odom comes from.", show_default="as --base"),
    ] = None,
    record: Annotated[Path | None, typer.Option(help="Folder for a bag of the drive.", show_default=False)] = None,
    storage: Annotated[Literal["mcap", "sqlite3"], typer.Option(help="Kind of that bag.")] = "mcap",
) -> None:
    """Run the simulated robot as a ROS 2 node: twist in; odometry, IMU, pose, joint states and ground truth out.

    It ends on Ctrl-C. What follows `--ros-args` goes to ROS: remappings, parameters.
    """
    if duration is not None and not duration > 0:
        raise ValueError(f"--duration {duration}: give a time in seconds, more than zero")
    arguments = ros_arguments(context)

    from diffdrive_mpc.mpc import load_trajectory  # noqa: PLC0415 - --help does without it, and without ROS
    from diffdrive_mpc.sim import make_plant  # noqa: PLC0415
    from diffdrive_mpc.sim.ros.base_settings import load_base_settings  # noqa: PLC0415
    from diffdrive_mpc.sim.ros.run_robot import run_robot  # noqa: PLC0415
    from diffdrive_mpc.sim.sensing.sensor_set import load_sensor_set  # noqa: PLC0415

    changes = {
        "stamped": stamped,
        "command_timeout": command_timeout,
        "odometry_pose": odometry_pose,
        "lock_step.answer_timeout": answer_timeout,
    }
    settings = load_base_settings(base, changes)
    start = load_trajectory(trajectory).sample([0.0]).pose[0]
    run_robot(
        make_plant(plant, surface, sensors, seed, scenario=scenario),
        start,
        settings,
        load_sensor_set(sensors),
        lock_step=lock_step,
        duration=duration,
        record=record,
        storage=storage,
        ros_arguments=arguments,
    )
