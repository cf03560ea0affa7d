"""`diffdrive-mpc config`: show, check and explain controller configurations."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from diffdrive_mpc.app.command_line.echo import echo
from diffdrive_mpc.app.command_line.groups import FullHelp
from diffdrive_mpc.app.commands.options import RobotName

config_app = typer.Typer(
    cls=FullHelp, no_args_is_help=True, rich_markup_mode=None, help="Show and check configurations; list their keys."
)


@config_app.command(epilog="Example: diffdrive-mpc config show ssm > my_robot.yaml")
def show(
    source: Annotated[
        str,
        typer.Argument(
            metavar="MODEL|FILE",
            help="mbm, sm, ssm, two_delays, lstm, p2_experimental, p2_physical, kinematic, or a configuration file.",
        ),
    ],
    *,
    robot: RobotName = None,
) -> None:
    """Print every value of a configuration as a commented YAML file."""
    from diffdrive_mpc.mpc.config.config_file import load_config  # noqa: PLC0415
    from diffdrive_mpc.mpc.config.described import commented_yaml  # noqa: PLC0415 - --help does not need it

    if robot is None:
        echo(commented_yaml(load_config(source)), nl=False)
        return
    from diffdrive_mpc.models.identification.settings import identification_settings  # noqa: PLC0415
    from diffdrive_mpc.models.stated_robot import load_stated_robot  # noqa: PLC0415

    stated = load_stated_robot(robot)
    keys, bounds = stated.configuration(), stated.bounds(identification_settings().limit_margin)
    config = load_config(source, bounds | {key: value.value for key, value in keys.items()})
    header = [f"{stated.name}, according to the manufacturer's data; no value is identified:", *stated.lines()]
    sources = f"values from the data: {', '.join(keys)}; derived values: {', '.join(bounds)}"
    echo("\n".join(f"# {line}" for line in [*header, sources]))
    echo(commented_yaml(config), nl=False)


@config_app.command(epilog="Example: diffdrive-mpc config check my_robot.yaml")
def check(
    file: Annotated[str, typer.Argument(metavar="FILE", help="A configuration file.")],
    *,
    trajectory: Annotated[
        str | None,
        typer.Option(metavar="NAME|FILE", help="Also check this trajectory against the limits of the robot."),
    ] = None,
) -> None:
    """Check that a configuration file is valid and a controller can be created; Python files of terms are not run."""
    from diffdrive_mpc.app.config_report import check_term_files, feasibility, robot_defaults  # noqa: PLC0415 - see show
    from diffdrive_mpc.mpc import Controller, load_config  # noqa: PLC0415

    config = load_config(file)
    not_run = check_term_files(config)
    controller = Controller(config.model_copy(update={"terms": []}))
    echo(
        f"{file}: valid, horizon {config.horizon} steps of {config.sample_time:g} s "
        f"({config.horizon * config.sample_time:.2f} s)"
    )
    unset = robot_defaults(config)
    if unset:
        echo(f"note: default values of the papers' robot: {', '.join(unset)}; set the values of your robot")
    if not_run:
        echo(f"note: not run: {', '.join(not_run)}; a controller runs these Python files, so inspect them before use")
    for line in feasibility(controller, trajectory) if trajectory else ():
        echo(line)


@config_app.command(epilog="Example: diffdrive-mpc config schema weights")
def schema(
    part: Annotated[
        str | None,
        typer.Argument(
            metavar="KEY",
            help="A group or key, such as weights or limits.v; with --json controller, model or trajectory.",
            show_default="all keys",
        ),
    ] = None,
    *,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print the JSON Schema of a kind of file; by default controller.")
    ] = False,
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="File for the JSON Schema.", show_default="standard output")
    ] = None,
) -> None:
    """List all keys or the keys of a group with default, unit, range and meaning.

    If the first line of a YAML file is `# yaml-language-server: $schema=FILE`, editors complete and check the keys.
    """
    if not as_json:
        from diffdrive_mpc.app.config_report import print_schema  # noqa: PLC0415
        from diffdrive_mpc.models.checked_yaml import ConfigError  # noqa: PLC0415

        if out is not None:
            raise ConfigError("--out: the option applies to the JSON Schema only; also pass --json")
        print_schema(part)
        return
    from diffdrive_mpc.app.schemas import json_schema  # noqa: PLC0415
    from diffdrive_mpc.models.whole_file import whole_file  # noqa: PLC0415

    text = json_schema(part or "controller")
    if out is None:
        echo(text, nl=False)
        return
    with whole_file(out, begins=b"{") as draft:
        draft.write_text(text, encoding="utf-8")
