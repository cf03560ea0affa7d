"""The command that makes a film of a log."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from diffdrive_mpc.app.commands.film_options import (
    Alone,
    CameraName,
    Fps,
    From,
    Render,
    Size,
    Speed,
    To,
    film_file,
)
from diffdrive_mpc.app.commands.options import ConfigFile, Mapping

EXAMPLE = "Example: diffdrive-mpc animate run.csv --out run.mp4 --render --film-speed 2 --from 3 --to 8"


def animate(
    log: Annotated[Path, typer.Argument(metavar="LOG", help="A log of simulate or of the node, or a robot's own.")],
    *,
    out: Annotated[Path, typer.Option("--out", help="The film: .mp4, .webp, .gif; .png: its last picture.")],
    mapping: Mapping = None,
    plant: Annotated[
        str | None,
        typer.Option(
            help="Which robot it was: mujoco, or mujoco:ROBOT.",
            show_default="mujoco for a log of simulate, else unknown",
        ),
    ] = None,
    surface: Annotated[
        str | None, typer.Option(help="Floor in MuJoCo's picture.", show_default="what the log says, or default")
    ] = None,
    config: ConfigFile = None,
    render: Render = False,
    alone: Alone = False,
    camera: CameraName = "chase",
    speed: Speed = 1.0,
    fps: Fps = None,
    size: Size = None,
    start: From = None,
    end: To = None,
) -> None:
    """Make a film of a drive from its log alone: robot, plan, reference, band, errors, commands and what was said.

    The limits of commands are drawn where log or --config says them.
    """
    from diffdrive_mpc.app.animation.animate import animate_log  # noqa: PLC0415 - --help does without it

    film = film_file(
        out,
        render=render,
        alone=alone,
        camera=camera,
        speed=speed,
        fps=fps,
        size=size,
        start=start,
        end=end,
    )
    animate_log(log, film, mapping=mapping, plant=plant, surface=surface, config=config)
