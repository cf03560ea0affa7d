"""The commands that drive: `simulate` one case, `bench` many of them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from diffdrive_mpc.app.command_line.echo import echo
from diffdrive_mpc.app.command_line.one_line_errors import FAILED
from diffdrive_mpc.app.command_line.options import Jobs, out_folder, out_option
from diffdrive_mpc.app.commands.options import (
    ConfigFile,
    Mapping,
    Scaled,
    Settings,
    Sweep,
    TrustedFolders,
    with_dimensions,
)
from diffdrive_mpc.bench.case import HORIZONS

if TYPE_CHECKING:
    from diffdrive_mpc.app.animation.animate import FilmFile


# `diffdrive-mpc replay`: what a controller would have commanded in a recorded drive, beside what was commanded.


REPLAY_EXAMPLE = "Example: diffdrive-mpc replay drive.csv --config my_robot/config.yaml --out replayed"
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
    from diffdrive_mpc.app.replay.study import ReplayRequest, replay_into  # noqa: PLC0415 - --help does without it

    if pose not in ("log", "odometry"):
        raise ValueError(f"--pose '{pose}': give log or odometry")
    request = ReplayRequest(
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
    replay_into(request, out or Path(_DEFAULT_OUT))


# Options of films, which `simulate` and `animate` share.


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
    from diffdrive_mpc.app.animation.film import (  # noqa: PLC0415
        SMALL,
        Film,
        read_size,
    )
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


_BENCH_OUT = "out/bench"
SIMULATE_EXAMPLE = "Example: diffdrive-mpc simulate --model ssm --trajectory square --set horizon=20 --out results"
BENCH_EXAMPLE = "Example: diffdrive-mpc bench --out results --models ssm --set weights.across=60,120,240"


@with_dimensions()
def simulate(
    *,
    config: ConfigFile = None,
    settings: Settings = None,
    out: Annotated[Path | None, out_option("report.html and figures")] = None,
    log: Annotated[
        Path | None, typer.Option(help="File for the log of the run: .csv or .mcap.", show_default=False)
    ] = None,
    rerun: Annotated[
        str | None,
        typer.Option(metavar="live|FILE.rrd", help="Show it in Rerun, or write a file for it.", show_default=False),
    ] = None,
    scale_to_robot: Scaled = False,
    animate: Annotated[
        Path | None,
        typer.Option(
            help="A film of it: .mp4, .webp, .gif; .png: its last picture.",
            show_default=False,
            rich_help_panel="Pictures",
        ),
    ] = None,
    render: Render = False,
    alone: Alone = False,
    camera: CameraName = "chase",
    film_speed: Speed = 1.0,
    fps: Fps = None,
    size: Size = None,
    start: From = None,
    end: To = None,
    view: Annotated[
        bool, typer.Option("--view", help="Watch it in MuJoCo's viewer, in real time.", rich_help_panel="Pictures")
    ] = False,
    details: Annotated[bool, typer.Option("--details", help="Print the tables instead of the summary.")] = False,
    **values: Any,  # noqa: ANN401 - text or number
) -> None:
    """Run one closed loop and print how well it tracked; --out draws it, --log writes it, --animate films it."""
    if (render or alone) and animate is None:
        raise ValueError("--render is of a film: give --animate FILE, too; to watch it drive, --view")
    film = None
    if animate is not None:
        film = film_file(
            animate,
            render=render,
            alone=alone,
            camera=camera,
            speed=film_speed,
            fps=fps,
            size=size,
            start=start,
            end=end,
            surface=values["surface"],
        )
    from diffdrive_mpc.app.simulate.single import simulate_one  # noqa: PLC0415 - --help does without it

    simulate_one(
        values,
        config=config,
        settings=settings or [],
        out=out,
        log=log,
        rerun=rerun,
        scaled=scale_to_robot,
        film=film,
        view=view,
        details=details,
    )


@with_dimensions(several=True)
def bench(
    *,
    out: Annotated[Path | None, out_option("report.html, bench.json, bench.md and figures/", _BENCH_OUT)] = None,
    config: ConfigFile = None,
    settings: Sweep = None,
    horizons: Annotated[
        str | None,
        typer.Option(
            metavar="LIST|none",
            help="Horizons to sweep in steps.",
            show_default=f"none; {','.join(map(str, HORIZONS))} with --sweeps",
        ),
    ] = None,
    sweeps: Annotated[
        bool, typer.Option("--sweeps", help="Sweep horizons, speeds and dead times, and drive other seeds, too.")
    ] = False,
    jobs: Jobs = None,
    quick: Annotated[bool, typer.Option("--quick", help="One seed.")] = False,
    scale_to_robot: Scaled = False,
    spec: Annotated[
        Path | None,
        typer.Option(help="Drive an experiment that this file states; takes --out and --jobs.", show_default=False),
    ] = None,
    **values: str | None,
) -> None:
    """Compare controllers on trajectories. Options that name several things take them with commas between.

    The exit code is 1 when a run of the predictive controller did not complete; the report is written all the same.
    """
    from diffdrive_mpc.bench.comparison.plan import read_options  # noqa: PLC0415 - --help does without it
    from diffdrive_mpc.bench.comparison.results import incomplete  # noqa: PLC0415
    from diffdrive_mpc.bench.comparison.study import ComparisonStudy  # noqa: PLC0415
    from diffdrive_mpc.bench.study import carry_out  # noqa: PLC0415

    if spec is not None:
        from diffdrive_mpc.bench.spec import SpecStudy, load_experiment  # noqa: PLC0415

        if any((config, settings, horizons, sweeps, quick, scale_to_robot, *values.values())):
            raise ValueError("--spec: the file says what is driven; give --out and --jobs beside it, nothing else")
        carry_out(SpecStudy(load_experiment(spec)), out or Path(_BENCH_OUT), jobs)
        return
    request = read_options(
        values,
        horizons=horizons,
        config=config,
        settings=settings or [],
        quick=quick,
        scaled=scale_to_robot,
        sweeps=sweeps,
    )
    complaint = incomplete(carry_out(ComparisonStudy(request), out or Path(_BENCH_OUT), jobs))
    if complaint:
        echo(f"error: {complaint}", err=True)
        raise typer.Exit(FAILED)


# The command that makes a film of a log.


ANIMATE_EXAMPLE = "Example: diffdrive-mpc animate run.csv --out run.mp4 --render --film-speed 2 --from 3 --to 8"


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
