"""`diffdrive-mpc commission`: from an unknown robot to a proven controller."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from diffdrive_mpc.app.commands.excite import read_room
from diffdrive_mpc.app.commands.options import Mapping
from diffdrive_mpc.bench.command_line.completion import choices
from diffdrive_mpc.bench.command_line.one_line_errors import FAILED
from diffdrive_mpc.bench.command_line.study_options import Jobs, file_option, out_option

EXAMPLE = "Example: diffdrive-mpc commission heavy --inside 5x4 --out my_robot --quick"


def commission(
    *,
    robot: Annotated[
        str | None,
        typer.Argument(
            help="Robot of the physics that stands in for yours: a shipped name or a file.",
            show_default="none: a person drives",
        ),
    ] = None,
    out: Annotated[Path, out_option("a folder of each step, commission.json, and robot/ in the end")],
    inside: Annotated[str, typer.Option(metavar="LxW", help="Room in which it drives [m].")] = "5x4",
    config: Annotated[
        str, typer.Option(help="What drives it at first: a file, or mbm, sm, ssm.", autocompletion=choices("config"))
    ] = "ssm",
    known: Annotated[
        str | None,
        typer.Option(metavar="NAME|FILE", help="What is known of the robot (YAML), for the twin.", show_default=False),
    ] = None,
    log: Annotated[
        list[Path] | None, typer.Option(help="Log of the drive that was asked for; repeatable.", show_default=False)
    ] = None,
    mapping: Mapping = None,
    step: Annotated[bool, typer.Option("--step", help="Do only the next step that is not done.")] = False,
    tune: Annotated[bool, typer.Option("--tune/--no-tune", help="Tune the weights on the twin.")] = True,
    plan: Annotated[Path | None, file_option("Plan of the tuning", "--plan")] = None,
    runs: Annotated[int | None, typer.Option(min=1, help="Of the proof.", show_default="300")] = None,
    scale_to_robot: Annotated[
        bool, typer.Option("--scale-to-robot", help="Fit the proof's paths to the robot.")
    ] = False,
    drawn: Annotated[
        int | None,
        typer.Option(min=0, help="Commission a robot that is drawn from this seed, and compare.", show_default=False),
    ] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="Short drives, few runs, no tuning: to see that it works.")
    ] = False,
    seed: Annotated[int, typer.Option(min=0, help="Of searches, and of the noise of the drives.")] = 0,
    jobs: Jobs = None,
) -> None:
    """Excite, record, identify, fit a twin, tune and prove: each step once, each gated by the one before.

    The robot is a simulated one, or a person drives: then the command says what to drive, and takes the log. The exit
    code is 1 where a step does not pass.
    """
    from diffdrive_mpc.app.commission.commissioning import Asked, NeedsAPersonError  # noqa: PLC0415 - --help
    from diffdrive_mpc.app.commission.run import commission_into  # noqa: PLC0415
    from diffdrive_mpc.app.commission.settings import commission_settings  # noqa: PLC0415
    from diffdrive_mpc.mpc.trajectories.model_excitation import Room  # noqa: PLC0415

    if drawn is not None and robot is not None:
        raise ValueError(f"--drawn {drawn}: it draws the robot; leave '{robot}' out")
    simulated = robot is not None or drawn is not None
    if log and simulated:
        raise ValueError("--log: the simulated robot is driven here; leave it out, or the robot")
    asked = Asked(
        Room(*read_room(inside)),
        robot,
        config,
        known,
        tuple(log or ()),
        mapping,
        tuned=tune,
        plan=None if plan is None else str(plan),
        scaled=scale_to_robot,
        seed=seed,
        jobs=jobs,
        runs=commission_settings().proof.runs if runs is None else runs,
    )
    if quick and (runs is not None or plan is not None):
        raise ValueError("--quick has runs of its own and does not tune; leave --runs and --plan out")
    try:
        passed = commission_into(asked.quick() if quick else asked, out, one=step, drawn=drawn)
    except NeedsAPersonError as need:
        typer.echo(f"Next: {need}.")
        return
    if not passed:
        raise typer.Exit(FAILED)
