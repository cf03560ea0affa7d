"""The command line `diffdrive-mpc`. Commands live in `app.commands`, and import what they need when they run."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from typing import Annotated, Any

import typer

from diffdrive_mpc.app.commands import (
    animate,
    campaign,
    commission,
    doctor,
    drives,
    excite,
    export,
    identify,
    monitor,
    prove,
    replay,
    ros,
    schema,
    tune,
    twin,
)
from diffdrive_mpc.app.commands.config import config_app
from diffdrive_mpc.app.commands.log import log_app
from diffdrive_mpc.app.commands.models import models_app
from diffdrive_mpc.app.commands.options import PASSED_ON
from diffdrive_mpc.bench.command_line.one_line_errors import OneLineErrors, build_only_named, leave_on_sigterm
from diffdrive_mpc.models.plug_ins import plug_ins

MOVED = {
    "robot": "`diffdrive-mpc sim-robot`",
    "study": "`python -m studies`, in a clone of the repository",
    "monitor-study": "`python -m studies monitor`, in a clone of the repository",
} | {
    name: f"`python -m studies {name}`, in a clone of the repository"
    for name in (
        "tracking",
        "robustness",
        "worlds",
        "peers",
        "reproduce",
        "saving",
        "energy-front",
        "speed",
        "loop-speed",
        "real-logs",
    )
}
"""Former names of commands, each with the present one."""


class Commands(OneLineErrors):
    """The commands; a former name is answered with the present one."""

    def get_command(self, ctx: Any, cmd_name: str) -> Any:  # noqa: ANN401 - of classes that typer hides
        """The command of that name; None if there is none."""
        if cmd_name in MOVED and not ctx.resilient_parsing:
            raise ValueError(f"{cmd_name}: this command is {MOVED[cmd_name]} now")
        return super().get_command(ctx, cmd_name)


app = typer.Typer(
    cls=Commands,
    no_args_is_help=True,
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Model-predictive trajectory tracking for skid-steer and differential-drive robots.",
)


def _add(panel: str, name: str, command: Callable[..., None], example: str, **more: Any) -> None:  # noqa: ANN401 - of typer
    app.command(name, epilog=example, rich_help_panel=panel, **more)(command)


_add("Drive", "simulate", drives.simulate, drives.EXAMPLES["simulate"])
_add("Drive", "bench", drives.bench, drives.EXAMPLES["bench"])
_add("Drive", "campaign", campaign.campaign, campaign.EXAMPLE)
_add("Drive", "replay", replay.replay, replay.EXAMPLE)
_add("Drive", "animate", animate.animate, animate.EXAMPLE)
_add("Your robot", "identify", identify.identify, identify.EXAMPLE)
_add("Your robot", "excite", excite.excite, excite.EXAMPLE)
_add("Your robot", "twin", twin.twin, twin.EXAMPLE)
_add("Your robot", "tune", tune.tune, tune.EXAMPLE)
_add("Your robot", "prove", prove.prove, prove.EXAMPLE)
_add("Your robot", "commission", commission.commission, commission.EXAMPLE)
_add("Robot", "node", ros.node, ros.EXAMPLES["node"], context_settings=PASSED_ON)
_add("Robot", "sim-robot", ros.robot, ros.EXAMPLES["sim-robot"], context_settings=PASSED_ON)
_add("Robot", "monitor", monitor.monitor, monitor.EXAMPLE, context_settings=PASSED_ON)
_add("Robot", "export", export.export, export.EXAMPLE)
_add("Robot", "doctor", doctor.doctor, doctor.EXAMPLE)
_add("Files", "schema", schema.schema, schema.EXAMPLE)
for plugged in plug_ins("commands"):
    _add(plugged.panel, plugged.name, plugged.run, plugged.example)
app.add_typer(models_app, name="models", rich_help_panel="Files")
app.add_typer(config_app, name="config", rich_help_panel="Files")
app.add_typer(log_app, name="log", rich_help_panel="Files")


def _print_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        typer.echo(f"diffdrive-mpc {version('diffdrive-mpc')}")
        raise typer.Exit


@app.callback(epilog="Example: diffdrive-mpc bench --quick --out results")
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    """Model-predictive trajectory tracking for skid-steer and differential-drive robots."""


def main() -> None:
    """Entry point of the console command."""
    leave_on_sigterm()
    # A shell that completes a line says it elsewhere.
    if "_DIFFDRIVE_MPC_COMPLETE" not in os.environ:
        build_only_named(app, sys.argv[1:])
    app(prog_name="diffdrive-mpc")
