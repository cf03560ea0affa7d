"""`diffdrive-mpc log`: work with logs of drives."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from diffdrive_mpc.app.commands.options import ConfigFile, Settings, TrustedFolders
from diffdrive_mpc.app.former_names import WithFormerNames

log_app = typer.Typer(cls=WithFormerNames, no_args_is_help=True, help="Replay logs of drives.")


@log_app.callback()
def _log() -> None:
    """Replay logs of drives."""


@log_app.command(epilog="Example: diffdrive-mpc log replay drive.mcap --set weights.across=300")
def replay(
    log: Annotated[Path, typer.Argument(metavar="LOG", help="Log of simulate or of the node: .csv or .mcap.")],
    *,
    config: ConfigFile = None,
    model: Annotated[
        str | None,
        typer.Option(
            help="Velocity model in place of the configuration's.", show_default="that of --config, or of the log"
        ),
    ] = None,
    settings: Settings = None,
    trajectory: Annotated[
        str | None, typer.Option(metavar="NAME|FILE", help="Tracked reference.", show_default="the one in the log")
    ] = None,
    trust_terms: TrustedFolders = None,
) -> None:
    """Repeat every tick of a recorded drive, and print the largest difference of the commands [m/s, rad/s].

    The controller gets the recorded measurements, and believes that the recorded commands went out. A CSV log holds no
    configuration: give the one that drove by --config or --model.
    """
    from diffdrive_mpc.app.replay.replay import ReplayRequest, replay_log  # noqa: PLC0415 - --help does without it

    replay_log(ReplayRequest(log, config, model, settings or (), trajectory, trust_terms or ()))
