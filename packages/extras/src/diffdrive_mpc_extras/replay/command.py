"""`diffdrive-mpc log replay`: repeat a recorded drive tick by tick."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from diffdrive_mpc.app.command_line.options import PluggedCommand
from diffdrive_mpc.app.commands.options import ConfigFile, Settings, TrustedFolders


def replay(
    log: Annotated[Path, typer.Argument(metavar="LOG", help="MCAP log of simulate or of the node.")],
    *,
    config: ConfigFile = None,
    model: Annotated[
        str | None,
        typer.Option(
            help="Velocity model that replaces the model of the configuration.", show_default="of --config or the log"
        ),
    ] = None,
    settings: Settings = None,
    trajectory: Annotated[
        str | None, typer.Option(metavar="NAME|FILE", help="Tracked reference.", show_default="from the log")
    ] = None,
    trust_terms: TrustedFolders = None,
) -> None:
    """Repeat every tick of a recorded drive, and print the maximum difference of the commands [m/s, rad/s].

    The controller gets the recorded measurements; after each tick its command is replaced by the recorded command.
    """
    from diffdrive_mpc_extras.replay.replay import ReplayRequest, replay_log  # noqa: PLC0415 - --help does not need it

    replay_log(ReplayRequest(log, config, model, settings or (), trajectory, trust_terms or ()))


REPLAY = PluggedCommand("Commands", replay, "Example: diffdrive-mpc log replay drive.mcap --set weights.across=300")
