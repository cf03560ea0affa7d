"""Common options of several commands."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeVar

import typer

from diffdrive_mpc.app.command_line.options import file_option

if TYPE_CHECKING:
    from diffdrive_mpc.bench.case import Dimension

Command = TypeVar("Command", bound=Callable[..., None])

PASSED_ON = {"allow_extra_args": True, "ignore_unknown_options": True}
"""Settings of a command that passes the arguments after `--ros-args` to ROS."""


ConfigFile = Annotated[Path | None, file_option("Controller configuration with the name of its model", "--config")]
Settings = Annotated[
    list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Replace a configuration value; repeatable.")
]
Sweep = Annotated[
    list[str] | None, typer.Option("--set", metavar="KEY=V1,V2,...", help="Sweep a configuration value; repeatable.")
]
Model = Annotated[
    str | None,
    typer.Option(
        help="Velocity model: mbm, sm, ssm, two_delays, lstm, p2_experimental, p2_physical, kinematic, or the path of "
        "a file.",
        show_default="ssm, or the model of --config",
    ),
]
TrustedFolders = Annotated[
    list[Path] | None,
    typer.Option(
        "--trust-terms",
        metavar="FOLDER",
        help="Folder of files that may be opened and run if the log or run file refers to them; repeatable.",
        show_default="none; built-in files only",
    ),
]
Scaled = Annotated[
    bool,
    typer.Option(
        "--scale-to-robot", help="Adapt paths of segments to wheels.encoder_track and limits of the configuration."
    ),
]
Mapping = Annotated[
    str | None,
    typer.Option(
        metavar="NAME|FILE",
        help="Mapping of columns or topics to signals.",
        show_default="columns of simulate --log, or the default topics of a bag",
    ),
]
"""Option for the mapping of a log's columns or topics."""
RobotName = Annotated[
    str | None,
    typer.Option(
        "--robot",
        metavar="NAME|FILE",
        help="Robot whose data from the manufacturer are used: husky, jackal, warthog, dingo_d, turtlebot4, or a file.",
        show_default=False,
    ),
]


def with_dimensions(*names: str, several: bool = False) -> Callable[[Command], Command]:
    """Return a decorator that adds an option for each dimension of a case to a command with `**values`.

    Parameters
    ----------
    names
        Names of the dimensions; by default all of them.
    several
        True if the options accept lists. `values` are then strings by plural of the dimension's name, or None for an
        omitted option. If False, `values` are values by name of the dimension.
    """
    from diffdrive_mpc.bench.case import DIMENSIONS  # noqa: PLC0415 - the command `node` must not import bench

    build_option = _list_option if several else _single_option
    options = [build_option(dimension) for dimension in DIMENSIONS if not names or dimension.name in names]

    def add_options(command: Command) -> Command:
        signature = inspect.signature(command, eval_str=True)
        parameters = [entry for entry in signature.parameters.values() if entry.kind is not entry.VAR_KEYWORD]
        # Keyword-only options follow the arguments.
        ordered = sorted([*options, *parameters], key=lambda entry: entry.kind)
        command.__signature__ = signature.replace(parameters=ordered)  # type: ignore[attr-defined]
        return command

    return add_options


def _single_option(dimension: Dimension) -> inspect.Parameter:
    if dimension.name == "model":
        return inspect.Parameter("model", inspect.Parameter.KEYWORD_ONLY, default=None, annotation=Model)
    kind, minimum = type(dimension.default), 0 if isinstance(dimension.default, int) else None
    option = typer.Option(dimension.option, help=dimension.help, min=minimum)
    annotation = Annotated[kind, option]  # type: ignore[valid-type]
    return inspect.Parameter(
        dimension.name, inspect.Parameter.KEYWORD_ONLY, default=dimension.default, annotation=annotation
    )


def _list_option(dimension: Dimension) -> inspect.Parameter:
    default = ",".join(map(str, dimension.compared))
    option = typer.Option(dimension.list_option, metavar="LIST", help=dimension.list_help, show_default=default)
    annotation = Annotated[str | None, option]
    return inspect.Parameter(dimension.plural, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=annotation)


def ros_arguments(context: typer.Context) -> list[str]:
    """Return the arguments from `--ros-args` to the end; raise ValueError for unknown arguments before `--ros-args`."""
    words = list(context.args)
    unknown = words[: words.index("--ros-args")] if "--ros-args" in words else words
    if unknown:
        raise ValueError(f"unknown argument '{unknown[0]}'; see --help; arguments for ROS follow --ros-args")
    return words
