"""Command line `diffdrive-mpc` with the commands of `app.commands` and of installed packages.

A command imports its dependencies when it is run. Packages add commands by entry points of the group
`diffdrive_mpc.commands`; the name of an entry point is the name of the command, or `GROUP.NAME` for a command of a
group such as `models`.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from functools import cache
from importlib import import_module
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from diffdrive_mpc.app.command_line.echo import echo
from diffdrive_mpc.app.command_line.groups import PackagedGroup
from diffdrive_mpc.app.command_line.one_line_errors import OneLineErrors, build_named_options, leave_on_sigterm
from diffdrive_mpc.app.command_line.options import PluggedCommand
from diffdrive_mpc.models.errors import MissingPackageError
from diffdrive_mpc.models.plug_ins import plug_in, plug_in_names

if TYPE_CHECKING:
    app: typer.Typer

_HOME = "diffdrive_mpc.app.commands"


class Commands(PackagedGroup, OneLineErrors):
    """Group of the commands of this package and of installed packages."""


class CommandEntry(NamedTuple):
    """Location of a command in `app.commands`."""

    panel: str
    module: str
    function: str = ""
    """Name of the function; if empty, the name of the command."""
    passed_on: bool = False
    """True if the command forwards unknown arguments, for instance to ROS."""


_COMMANDS = {
    "simulate": CommandEntry("Drive", "drives"),
    "bench": CommandEntry("Drive", "drives"),
    "identify": CommandEntry("Your robot", "robot"),
    "node": CommandEntry("Robot", "node", passed_on=True),
    "sim-robot": CommandEntry("Robot", "ros", "robot", passed_on=True),
    "doctor": CommandEntry("Robot", "ros"),
}
_GROUPS = {"models": "models", "config": "config", "log": "log"}
"""Module of each group of commands."""


def command_line(words: Sequence[str] = ()) -> typer.Typer:
    """Build the command line.

    Parameters
    ----------
    words
        First words of the command line. If the first word is a command, only this command is imported; if it is a
        group, only the commands of the group are imported.
    """
    app = typer.Typer(
        cls=Commands,
        no_args_is_help=True,
        # Rich would parse units such as [m] as markup.
        rich_markup_mode=None,
        context_settings={"help_option_names": ["-h", "--help"]},
    )
    app.callback(epilog="Example: diffdrive-mpc bench --quick --out results")(_options)
    plugged = {name: name.partition(".") for name in plug_in_names("commands")}
    names = _COMMANDS.keys() | _GROUPS.keys() | {first for first, _, _ in plugged.values()}
    selected = {*words[:1]} & names or names
    for name, entry in _COMMANDS.items():
        if name in selected:
            _add_command(app, name, entry)
    groups = {}
    for name, module in _GROUPS.items():
        if name in selected:
            groups[name] = getattr(import_module(f"{_HOME}.{module}"), f"{name}_app")
            app.add_typer(groups[name], name=name, rich_help_panel="Files")
    for entry_name, (first, _, second) in plugged.items():
        is_needed = not second or not words[1:] or words[1] == second or words[1].startswith("-")
        if first in selected and is_needed:
            _add_plug_in(groups[first] if second else app, entry_name, second or first)
    return app


def _add_command(app: typer.Typer, name: str, entry: CommandEntry) -> None:
    home = import_module(f"{_HOME}.{entry.module}")
    function = entry.function or name
    example = getattr(home, f"{function.upper()}_EXAMPLE")
    add = app.command(name, epilog=example, rich_help_panel=entry.panel, context_settings=_settings(entry.passed_on))
    add(getattr(home, function))


def _add_plug_in(app: typer.Typer, entry_name: str, name: str) -> None:
    """Add the command of a package; if it cannot be imported, add a command that raises an error with the reason."""
    if name in {command.name for command in app.registered_commands}:
        return  # the command lines of a process share their groups
    try:
        plugged: PluggedCommand = plug_in("commands", entry_name)
    except ImportError as error:
        reason = f"{error}; install the package of this command again"

        def raise_missing() -> None:
            raise MissingPackageError(reason)

        raise_missing.__doc__ = f"Not available: {reason}."
        plugged = PluggedCommand("Not available", raise_missing, "")
    settings = _settings(plugged.passed_on)
    app.command(name, epilog=plugged.example, rich_help_panel=plugged.panel, context_settings=settings)(plugged.run)


def _settings(passed_on: bool) -> dict[str, Any] | None:
    return import_module(f"{_HOME}.options").PASSED_ON if passed_on else None


def _print_version(is_requested: bool) -> None:
    if is_requested:
        from importlib.metadata import version

        echo(f"diffdrive-mpc {version('diffdrive-mpc')}")
        raise typer.Exit


def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    """Track trajectories with skid-steer and differential-drive robots by model-predictive control."""


@cache
def __getattr__(name: str) -> typer.Typer:
    """Create `app`, the complete command line, on first access."""
    if name != "app":
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    return command_line()


def main() -> None:
    """Run the console command."""
    leave_on_sigterm()
    # The matrices are small and studies run in several processes, so threads of NumPy take more time than they save.
    # The number of threads also changes rounding errors. Settings of the user take precedence.
    for library in ("OPENBLAS", "OMP", "MKL"):
        os.environ.setdefault(f"{library}_NUM_THREADS", "1")
    is_completion = "_DIFFDRIVE_MPC_COMPLETE" in os.environ
    app = command_line([] if is_completion else sys.argv[1:3])
    # Shell completion needs the complete options.
    if not is_completion:
        build_named_options(app, sys.argv[1:])
    app(prog_name="diffdrive-mpc")
