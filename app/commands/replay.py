"""`diffdrive-mpc replay`: what a controller would have commanded in a recorded drive, beside what was commanded."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from diffdrive_mpc.app.commands.options import ConfigFile, Mapping, Settings, TrustedFolders
from diffdrive_mpc.bench.command_line.study_options import out_folder

EXAMPLE = "Example: diffdrive-mpc replay drive.csv --config my_robot/config.yaml --out replayed"
_DEFAULT_OUT = "replayed"


def replay(
    *,
    log: Annotated[Path, typer.Argument(metavar="LOG", help="CSV file, or ROS 2 bag.")],
    config: ConfigFile = None,
    model: Annotated[
        str | None,
        typer.Option(
            help="Velocity model in place of the configuration's.", show_default="that of --config, or of the log"
        ),
    ] = None,
    settings: Settings = None,
    trajectory: Annotated[
        str | None,
        typer.Option(
            metavar="NAME|FILE",
            help="What it should have tracked.",
            show_default="the reference in the log, else the path that was driven",
        ),
    ] = None,
    start_at_robot: Annotated[
        bool, typer.Option("--start-at-robot", help="Lay the trajectory to the first pose, as the node does.")
    ] = False,
    against: Annotated[
        str | None,
        typer.Option(metavar="NAME|FILE", help="A second configuration beside the first.", show_default=False),
    ] = None,
    beside: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="replay.csv of an earlier replay, such as one by another release.", show_default=False
        ),
    ] = None,
    mapping: Mapping = None,
    pose: Annotated[
        str, typer.Option(metavar="log|odometry", help="Poses of the log, or dead reckoning in their place.")
    ] = "log",
    begin: Annotated[
        float | None,
        typer.Option("--from", metavar="SECONDS", help="Count from here on, on the log's clock.", show_default=False),
    ] = None,
    end: Annotated[
        float | None,
        typer.Option("--to", metavar="SECONDS", help="End here, on the log's clock.", show_default=False),
    ] = None,
    sample_time: Annotated[
        float | None,
        typer.Option(metavar="SECONDS", help="Of the controller.", show_default="that of the configuration"),
    ] = None,
    trust_terms: TrustedFolders = None,
    out: Annotated[
        Path | None,
        typer.Option(
            parser=out_folder,
            metavar="PATH",
            help="Folder for replay.csv, replay.json, replay.md, the page and figures.",
            show_default=_DEFAULT_OUT,
        ),
    ] = None,
) -> None:
    """Give a controller what was recorded, open loop, and compare its commands with those that were sent.

    The measurements are those of the log, and the controller believes that the recorded commands went out.
    """
    from diffdrive_mpc.app.replay.command import replay_into  # noqa: PLC0415 - --help does without it
    from diffdrive_mpc.app.replay.study import Asked  # noqa: PLC0415

    if pose not in ("log", "odometry"):
        raise ValueError(f"--pose '{pose}': give log or odometry")
    asked = Asked(
        log=log,
        config=config,
        model=model,
        settings=settings or (),
        trajectory=trajectory,
        start_at_robot=start_at_robot,
        against=against,
        beside=beside,
        mapping=mapping,
        pose="odometry" if pose == "odometry" else "log",
        begin=begin,
        end=end,
        sample_time=sample_time,
        trusted=trust_terms or (),
    )
    replay_into(asked, out or Path(_DEFAULT_OUT))
