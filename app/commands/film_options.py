"""Options of films, which `simulate` and `animate` share."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from diffdrive_mpc.app.animation.animate import FilmFile

_PANEL = "Pictures"

Render = Annotated[
    bool, typer.Option("--render", help="MuJoCo's picture of the robot beside it.", rich_help_panel=_PANEL)
]
Alone = Annotated[
    bool, typer.Option("--render-alone", help="MuJoCo's picture and nothing else.", rich_help_panel=_PANEL)
]
CameraName = Annotated[
    str, typer.Option("--camera", metavar="chase|fixed", help="Of MuJoCo's picture.", rich_help_panel=_PANEL)
]
Speed = Annotated[float, typer.Option("--film-speed", help="Times as fast as the robot was.", rich_help_panel=_PANEL)]
Fps = Annotated[
    int | None,
    typer.Option(
        "--fps", min=1, max=120, help="Pictures a second.", show_default="30; WebP, GIF: 15", rich_help_panel=_PANEL
    ),
]
Size = Annotated[
    str | None,
    typer.Option(
        "--size", metavar="WxH", help="Pixels.", show_default="1280x720; WebP, GIF: 800x450", rich_help_panel=_PANEL
    ),
]
From = Annotated[
    float | None, typer.Option("--from", help="Only from this time on, in seconds.", rich_help_panel=_PANEL)
]
To = Annotated[float | None, typer.Option("--to", help="Only up to this time, in seconds.", rich_help_panel=_PANEL)]


def film_file(
    path: Path,
    *,
    render: bool,
    alone: bool,
    camera: str,
    speed: float,
    fps: int | None,
    size: str | None,
    start: float | None,
    end: float | None,
    surface: str = "default",
) -> FilmFile:
    """What was asked for, checked; raises ConfigError or ValueError that names the option."""
    from diffdrive_mpc.app.animation.animate import FilmFile  # noqa: PLC0415 - --help does without it
    from diffdrive_mpc.app.animation.film import Film, read_size  # noqa: PLC0415
    from diffdrive_mpc.app.animation.film_file import SMALL  # noqa: PLC0415
    from diffdrive_mpc.sim.view.shots import Camera  # noqa: PLC0415

    if camera not in list(Camera):
        raise ValueError(f"--camera '{camera}': give {' or '.join(Camera)}")
    if not 0.01 <= speed <= 1000:
        raise ValueError(f"--film-speed {speed}: give a number from 0.01 to 1000")
    small = path.suffix.lower() in SMALL
    film = Film(
        size=read_size(size or ("800x450" if small else "1280x720")),
        fps=fps or (15 if small else 30),
        speed=speed,
        start=start,
        end=end,
        render=render and not alone,
        alone=alone,
        camera=Camera(camera),
        surface=surface,
    )
    return FilmFile(path, film)
