"""The commands that drive: `simulate` one case, `bench` many of them."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Annotated, Any

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
from diffdrive_mpc.app.commands.options import ConfigFile, Scaled, Settings, Sweep, TrustedFolders, with_dimensions
from diffdrive_mpc.bench.case import DIMENSIONS, HORIZONS
from diffdrive_mpc.bench.command_line.one_line_errors import FAILED
from diffdrive_mpc.bench.command_line.study_options import Jobs, out_option

DEFAULTS = {one.name: None if one.name == "model" else one.default for one in DIMENSIONS}
"""Values of the options of `simulate` where they are not given."""
_BENCH_OUT = "out/bench"
EXAMPLES = {
    "simulate": "Example: diffdrive-mpc simulate --model ssm --trajectory square --set horizon=20 --out results",
    "bench": "Example: diffdrive-mpc bench --out results --models ssm --set weights.across=60,120,240",
}


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
    laps: Annotated[int, typer.Option(min=1, max=1000, help="Drive it so often, and learn from lap to lap.")] = 1,
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
    from_run: Annotated[
        Path | None,
        typer.Option(help="Drive a run that `prove` kept again; takes --out, --log and --details.", show_default=False),
    ] = None,
    trust_terms: TrustedFolders = None,
    details: Annotated[bool, typer.Option("--details", help="Print the tables instead of the summary.")] = False,
    **values: Any,  # noqa: ANN401 - text or number
) -> None:
    """Run one closed loop and print how well it tracked; --out draws it, --log writes it, --animate films it.

    With --from-run the exit code is 1 when the figures are not those of the file.
    """
    if (render or alone) and animate is None:
        raise ValueError("--render is of a film: give --animate FILE, too; to watch it drive, --view")
    if (animate is not None or view) and (laps != 1 or from_run is not None):
        raise ValueError("--animate and --view show one drive: leave --laps and --from-run out")
    if trust_terms and from_run is None:
        raise ValueError("--trust-terms: files of a run file's folder; give --from-run, too, or leave it out")
    if from_run is not None:
        from diffdrive_mpc.app.simulate.again import simulate_again  # noqa: PLC0415 - --help does without it

        said = {name: value for name, value in values.items() if value != DEFAULTS[name]}
        if said or config is not None or settings or laps != 1 or scale_to_robot or rerun is not None:
            raise ValueError(
                "--from-run: the file says what is driven; give --out, --log and --details beside it, nothing else"
            )
        if not simulate_again(from_run, out, log, trust_terms or (), details=details):
            raise typer.Exit(FAILED)
        return
    if laps != 1 and details:
        raise ValueError("--details: with --laps there is one table, which is printed anyway; leave it out")
    if laps != 1 and rerun is not None:
        raise ValueError("--rerun: it shows one drive; write the last lap with --log, and show it by `log rerun`")
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
    run: Callable[..., None]
    if laps == 1:
        from diffdrive_mpc.app.simulate.single import simulate_one  # noqa: PLC0415 - --help does without it

        run = partial(simulate_one, rerun=rerun, film=film, view=view, details=details)
    else:
        from diffdrive_mpc.app.simulate.laps import simulate_laps  # noqa: PLC0415

        run = partial(simulate_laps, laps=laps)
    run(values, config=config, settings=settings or [], out=out, log=log, scaled=scale_to_robot)


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
    asked = read_options(
        values,
        horizons=horizons,
        config=config,
        settings=settings or [],
        quick=quick,
        scaled=scale_to_robot,
        sweeps=sweeps,
    )
    complaint = incomplete(carry_out(ComparisonStudy(asked), out or Path(_BENCH_OUT), jobs))
    if complaint:
        typer.echo(f"error: {complaint}", err=True)
        raise typer.Exit(FAILED)
