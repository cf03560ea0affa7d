"""`diffdrive-mpc config`: show, check and explain controller configurations."""

from __future__ import annotations

from typing import Annotated

import typer

config_app = typer.Typer(no_args_is_help=True, help="Show, check and explain controller configurations.")


@config_app.command(epilog="Example: diffdrive-mpc config show ssm > my_robot.yaml")
def show(
    source: Annotated[str, typer.Argument(metavar="MODEL|FILE", help="mbm, sm, ssm, or a configuration file.")],
) -> None:
    """Print every value of a configuration as a commented YAML file."""
    from diffdrive_mpc.bench.config_report import commented_yaml  # noqa: PLC0415 - --help does without it
    from diffdrive_mpc.mpc.config.config_file import load_config  # noqa: PLC0415

    typer.echo(commented_yaml(load_config(source)), nl=False)


@config_app.command(epilog="Example: diffdrive-mpc config check my_robot.yaml")
def check(file: Annotated[str, typer.Argument(metavar="FILE", help="A configuration file.")]) -> None:
    """Check a configuration file, and that a controller can be built from it."""
    from diffdrive_mpc.mpc import Controller, load_config  # noqa: PLC0415

    config = load_config(file)
    Controller(config)
    typer.echo(
        f"{file}: valid, horizon {config.horizon} steps of {config.sample_time:g} s "
        f"({config.horizon * config.sample_time:.2f} s)"
    )


@config_app.command(epilog="Example: diffdrive-mpc config schema --json > schema.json")
def schema(
    as_json: Annotated[bool, typer.Option("--json", help="The JSON schema instead of the table.")] = False,
) -> None:
    """List every key with its default, unit, range and meaning."""
    from diffdrive_mpc.bench.config_report import json_schema, print_schema  # noqa: PLC0415

    if as_json:
        typer.echo(json_schema())
    else:
        print_schema()
