"""The command line `diffdrive-mpc`. Commands live in `app.commands`, and import what they need when they run."""

from __future__ import annotations

import os
import sys
from functools import cache
from importlib import import_module
from typing import TYPE_CHECKING, Annotated, NamedTuple

import typer

from diffdrive_mpc.app.former_names import WithFormerNames
from diffdrive_mpc.bench.command_line.echo import echo
from diffdrive_mpc.bench.command_line.one_line_errors import OneLineErrors, build_only_named, leave_on_sigterm

if TYPE_CHECKING:
    from diffdrive_mpc.bench.command_line.options import PluggedCommand

    app: typer.Typer

_HOME = "diffdrive_mpc.app.commands"


class Commands(WithFormerNames, OneLineErrors):
    """The commands."""


class CommandEntry(NamedTuple):
    """Where a command is, below `app.commands`."""

    panel: str
    module: str
    function: str = ""
    """By default called as the command."""
    passed_on: bool = False
    """Whether words that it does not know are left to it."""


_COMMANDS = {
    "simulate": CommandEntry("Drive", "drives"),
    "bench": CommandEntry("Drive", "drives"),
    "campaign": CommandEntry("Drive", "drives"),
    "replay": CommandEntry("Drive", "drives"),
    "identify": CommandEntry("Your robot", "robot"),
    "excite": CommandEntry("Your robot", "robot"),
    "twin": CommandEntry("Your robot", "robot"),
    "tune": CommandEntry("Your robot", "robot"),
    "prove": CommandEntry("Your robot", "robot"),
    "predict-error": CommandEntry("Your robot", "robot", "predict_error"),
    "commission": CommandEntry("Your robot", "robot"),
    "node": CommandEntry("Robot", "ros", passed_on=True),
    "sim-robot": CommandEntry("Robot", "ros", "robot", passed_on=True),
    "monitor": CommandEntry("Robot", "ros", passed_on=True),
    "export": CommandEntry("Robot", "ros"),
    "doctor": CommandEntry("Robot", "ros"),
    "schema": CommandEntry("Files", "schema"),
}
_GROUPS = {"models": "models", "config": "config", "log": "log"}
"""Groups of commands, each with its module."""


def command_line(only: str = "") -> typer.Typer:
    """The command line; with `only` one of our commands of that name alone, for which no other is imported."""
    made = typer.Typer(
        cls=Commands,
        no_args_is_help=True,
        context_settings={"help_option_names": ["-h", "--help"]},
        help="Model-predictive trajectory tracking for skid-steer and differential-drive robots.",
    )
    made.callback(epilog="Example: diffdrive-mpc bench --quick --out results")(_options)
    every = _COMMANDS.keys() | _GROUPS.keys()
    ours = {only} & every or every
    for name, (panel, module, function, passed_on) in _COMMANDS.items():
        if name in ours:
            home = import_module(f"{_HOME}.{module}")
            called = function or name
            example = getattr(home, f"{called.upper()}_EXAMPLE")
            settings = import_module(f"{_HOME}.options").PASSED_ON if passed_on else None
            add = made.command(name, epilog=example, rich_help_panel=panel, context_settings=settings)
            add(getattr(home, called))
    for plugged in _plugged() if ours == every else ():
        made.command(plugged.name, epilog=plugged.example, rich_help_panel=plugged.panel)(plugged.run)
    for name, module in _GROUPS.items():
        if name in ours:
            group = getattr(import_module(f"{_HOME}.{module}"), f"{name}_app")
            made.add_typer(group, name=name, rich_help_panel="Files")
    return made


def _plugged() -> tuple[PluggedCommand, ...]:
    from diffdrive_mpc.models.plug_ins import plug_ins

    return plug_ins("commands")


def _print_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        echo(f"diffdrive-mpc {version('diffdrive-mpc')}")
        raise typer.Exit


def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    """Model-predictive trajectory tracking for skid-steer and differential-drive robots."""


@cache
def __getattr__(name: str) -> typer.Typer:
    """`app`, the whole command line, made when it is first asked for."""
    if name != "app":
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    return command_line()


def main() -> None:
    """Entry point of the console command."""
    leave_on_sigterm()
    # Matrices are small, and campaigns have processes: threads of NumPy cost more than they bring, and another number
    # of them rounds otherwise. What the user sets counts.
    for library in ("OPENBLAS", "OMP", "MKL"):
        os.environ.setdefault(f"{library}_NUM_THREADS", "1")
    completing = "_DIFFDRIVE_MPC_COMPLETE" in os.environ
    app = command_line("" if completing else "".join(sys.argv[1:2]))
    # A shell that completes a line says it elsewhere.
    if not completing:
        build_only_named(app, sys.argv[1:])
    app(prog_name="diffdrive-mpc")
