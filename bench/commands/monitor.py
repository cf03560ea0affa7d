"""`diffdrive-mpc monitor`: the process that watches a controller; and what puts it to the test."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from diffdrive_mpc.bench.commands.options import Jobs, out_option, ros_arguments

EXAMPLES = {
    "monitor": "Example: diffdrive-mpc monitor --ros-args -r cmd_vel:=/base/cmd_vel",
    "monitor-study": "Example: diffdrive-mpc study monitor-study --out watched --seeds 2 --hours 0.2",
}

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
    """Stand between a controller and its base: pass on what keeps all rules, stop the robot at what breaks one.

    The controller has to publish `cmd_vel_unchecked` (node: `--ros-args -r cmd_vel:=cmd_vel_unchecked`). What follows
    `--ros-args` goes to ROS: remappings, parameters.
    """
    arguments = ros_arguments(context)
    if export is not None:
        from diffdrive_mpc.mpc.monitor.export import export_judge  # noqa: PLC0415 - --help does without it
        from diffdrive_mpc.mpc.monitor.rules import load_rules  # noqa: PLC0415

        typer.echo("\n".join(str(path) for path in export_judge(load_rules(rules), export)))
        return
    from diffdrive_mpc.mpc.monitor.ros.main import run  # noqa: PLC0415 - needs rclpy
    from diffdrive_mpc.mpc.monitor.ros.settings import MonitorSettings  # noqa: PLC0415

    run(arguments, MonitorSettings(rules=rules))


def monitor_study(
    *,
    out: Annotated[Path, out_option("monitor.md, monitor.json and figures/", "out/monitor")] = Path("out/monitor"),
    rules: RulesFile = "default",
    seeds: Annotated[int, typer.Option(min=1, max=1000, help="Drives of each fault.")] = 20,
    hours: Annotated[float, typer.Option(min=0.01, max=1000, help="Hours of nominal drives.")] = 10.0,
    tuning: Annotated[bool, typer.Option("--tuning", help="The seeds that the rules were tuned on.")] = False,
    jobs: Jobs = None,
) -> None:
    """Break controllers on purpose and drive for hours with sound ones: what the monitor catches, when, and what not.

    The exit code is 1 when a fault was missed or found late, or a nominal drive alarmed; the report is written all the
    same.
    """
    from diffdrive_mpc.bench.commands.one_line_errors import FAILED  # noqa: PLC0415 - --help does without it
    from diffdrive_mpc.bench.monitor.study import MonitorStudy, complaint  # noqa: PLC0415
    from diffdrive_mpc.bench.study import carry_out  # noqa: PLC0415

    found = complaint(carry_out(MonitorStudy(rules, seeds, hours, tuning=tuning), out, jobs))
    if found:
        typer.echo(f"error: {found}", err=True)
        raise typer.Exit(FAILED)
