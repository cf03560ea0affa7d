"""`diffdrive-mpc models`: list, show and check velocity models."""

from __future__ import annotations

from typing import Annotated

import typer

from diffdrive_mpc.app.command_line.echo import echo
from diffdrive_mpc.app.command_line.groups import PackagedGroup

models_app = typer.Typer(
    cls=PackagedGroup, no_args_is_help=True, rich_markup_mode=None, help="List, show and check velocity models."
)


@models_app.command("list", epilog="Example: diffdrive-mpc models list")
def list_models() -> None:
    """List the built-in models with order, lags, gains and origin."""
    from diffdrive_mpc.app.model_report import print_models  # noqa: PLC0415 - --help does not need it

    print_models()


@models_app.command(epilog="Example: diffdrive-mpc models show ssm")
def show(
    name: Annotated[
        str,
        typer.Argument(
            metavar="NAME|FILE",
            help="mbm, sm, ssm, two_delays, lstm, p2_experimental, p2_physical, kinematic, or a model file.",
        ),
    ],
) -> None:
    """Show a model: matrices, poles, gains, dead times, and the origin of the parameters."""
    from diffdrive_mpc.app.model_report import print_model  # noqa: PLC0415

    print_model(name)


@models_app.command(epilog="Example: diffdrive-mpc models check my_robot.yaml")
def check(file: Annotated[str, typer.Argument(metavar="FILE", help="A model file.")]) -> None:
    """Check the keys, the stability, the gains and the units of a model file."""
    from diffdrive_mpc.models.load import load_model  # noqa: PLC0415

    model = load_model(file)
    echo(f"{file}: valid, {model.structure.upper()} '{model.name}' with {model.order} states")
