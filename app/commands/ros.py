"""Commands `sim-robot`, which runs the simulated robot as a ROS 2 node, and `doctor`, which checks the installation."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from diffdrive_mpc.app.command_line.echo import echo
from diffdrive_mpc.app.command_line.one_line_errors import FAILED
from diffdrive_mpc.app.command_line.options import file_option
from diffdrive_mpc.app.commands.options import ros_arguments, with_dimensions

ROBOT_EXAMPLE = "Example: diffdrive-mpc sim-robot --trajectory s --lock-step --record out/drive"


@with_dimensions("plant", "surface", "sensors", "scenario", "seed")
def robot(
    context: typer.Context,
    *,
    trajectory: Annotated[
        str, typer.Option(metavar="NAME|FILE", help="Trajectory at whose start the robot stands; it is not driven.")
    ] = "circle",
    lock_step: Annotated[
        bool, typer.Option("--lock-step/--real-time", help="Publish /clock and wait for the command of every tick.")
    ] = False,
    duration: Annotated[
        float | None, typer.Option(help="Duration on the robot's clock in seconds.", show_default="no end")
    ] = None,
    config: Annotated[
        Path | None,
        file_option("Configuration of the controller's node, with sample time and limits of the robot", "--config"),
    ] = None,
    base: Annotated[Path | None, file_option("Settings of the base: rates, timeouts", "--base")] = None,
    stamped: Annotated[
        bool | None,
        typer.Option("--stamped/--unstamped", help="Commands are TwistStamped or Twist.", show_default="as --base"),
    ] = None,
    command_timeout: Annotated[
        float | None, typer.Option(help="Time without a command before a stop, in seconds.", show_default="as --base")
    ] = None,
    answer_timeout: Annotated[
        float | None,
        typer.Option(
            help="In lock step: maximum wait for the command of a tick, in seconds.", show_default="as --base"
        ),
    ] = None,
    odometry_pose: Annotated[
        Literal["dead_reckoning", "pose_sensor"] | None,
        typer.Option(help="Source of the pose in odom.", show_default="as --base"),
    ] = None,
    transforms: Annotated[
        Literal["none", "odom", "map"] | None,
        typer.Option(help="Transforms on /tf: odom -> base_link, or also map -> odom.", show_default="as --base"),
    ] = None,
    frame_prefix: Annotated[
        str | None, typer.Option(help="Prefix of all frames except map, such as r1/.", show_default="as --base")
    ] = None,
    record: Annotated[Path | None, typer.Option(help="Folder for a bag of the drive.", show_default=False)] = None,
    storage: Annotated[Literal["mcap", "sqlite3"], typer.Option(help="Storage format of the bag.")] = "mcap",
    **values: Any,  # noqa: ANN401 - text or number
) -> None:
    """Run the simulated robot as a ROS 2 node with a twist as input and odometry, IMU, pose, joint states as output.

    The robot stands at the start of the trajectory until a node drives it: `diffdrive-mpc node --trajectory NAME
    --drive`. It runs until Ctrl-C. Arguments after `--ros-args` are passed to ROS, for example remappings.
    """
    if duration is not None and not duration > 0:
        raise ValueError(f"--duration {duration}: use a time above zero in seconds")
    arguments = ros_arguments(context)

    from diffdrive_mpc.bench import controllers  # noqa: PLC0415 - --help needs neither this nor ROS
    from diffdrive_mpc.bench.case import Case  # noqa: PLC0415
    from diffdrive_mpc.bench.drive import odometry_correction, plant_settings  # noqa: PLC0415
    from diffdrive_mpc.mpc.trajectories.limits import BeyondLimitError  # noqa: PLC0415
    from diffdrive_mpc.sim import make_plant  # noqa: PLC0415
    from diffdrive_mpc.sim.ros.run_robot import run_robot  # noqa: PLC0415
    from diffdrive_mpc.sim.ros.simulated_base import load_base_settings  # noqa: PLC0415
    from diffdrive_mpc.sim.sensing.sensor_set import load_sensor_set  # noqa: PLC0415

    changes = {
        "stamped": stamped,
        "command_timeout": command_timeout,
        "odometry_pose": odometry_pose,
        "frame_prefix": frame_prefix,
        "transforms": transforms,
        "lock_step.answer_timeout": answer_timeout,
    }
    settings = load_base_settings(base, changes)
    values |= {"model": controllers.select_model(None, config), "config": None if config is None else str(config)}
    case = Case(trajectory=trajectory, **values)
    options = {} if config is None else plant_settings(controllers.controller_config(case.model, case.config))
    plant = make_plant(case.plant, case.surface, case.sensors, case.seed, scenario=case.scenario, **options)
    readings = options.get("readings", {})
    for sentence in () if config is None else controllers.other_robots([case]):
        echo(f"note: {sentence}")
    config_option = [] if config is None else ["--config", str(config)]
    driven = case.trajectory
    try:
        controllers.load_reference(case)
    except BeyondLimitError as error:
        echo(f"note: the node refuses this trajectory: {error}")
        driven = "FILE"
    driver = shlex.join(["diffdrive-mpc", "node", *config_option, "--trajectory", driven, "--drive"])
    run_robot(
        plant,
        controllers.start_pose(case),
        settings,
        load_sensor_set(values["sensors"], readings),
        correction=odometry_correction(readings) if readings else (1.0, 1.0),
        lock_step=lock_step,
        duration=duration,
        record=record,
        storage=storage,
        ros_arguments=arguments,
        driver=driver + " --ros-args -p use_sim_time:=true" * lock_step,
    )


# `diffdrive-mpc doctor`: checks of the installation.


DOCTOR_EXAMPLE = "Example: diffdrive-mpc doctor"


def doctor() -> None:
    """Check Python, dependencies, controller, MuJoCo and ROS 2; print one line per check, with a remedy if it fails.

    The exit code is 1 if the controller cannot run.
    """
    from diffdrive_mpc.app.doctor import examine  # noqa: PLC0415 - --help does not need it
    from diffdrive_mpc.bench.machine import project_version  # noqa: PLC0415

    echo(f"diffdrive-mpc {project_version()}")
    can_run = True
    for check in examine():
        echo(check.line)
        can_run &= check.is_ok or not check.is_required
    if not can_run:
        raise typer.Exit(FAILED)
