"""Commands that simulate the closed loop: `simulate` for one case, `bench` for many cases."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from diffdrive_mpc.app.command_line.echo import echo
from diffdrive_mpc.app.command_line.one_line_errors import FAILED
from diffdrive_mpc.app.command_line.options import Jobs, out_option
from diffdrive_mpc.app.commands.options import ConfigFile, Scaled, Settings, Sweep, with_dimensions
from diffdrive_mpc.bench.case import HORIZONS

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
        Path | None,
        typer.Option(help="File for the log of the run, .csv or .mcap; its folder is created.", show_default=False),
    ] = None,
    scale_to_robot: Scaled = False,
    details: Annotated[bool, typer.Option("--details", help="Print the tables instead of the summary.")] = False,
    **values: Any,  # noqa: ANN401 - text or number
) -> None:
    """Run one closed loop and print its tracking errors; --out writes a report, --log a log."""
    from diffdrive_mpc.app.simulate.single import simulate_one  # noqa: PLC0415 - --help does not need it

    simulate_one(
        values, config=config, settings=settings or [], out=out, log=log, scaled=scale_to_robot, details=details
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
        bool, typer.Option("--sweeps", help="Also sweep horizons, speeds, dead times and further seeds.")
    ] = False,
    jobs: Jobs = None,
    quick: Annotated[bool, typer.Option("--quick", help="One seed unless --seeds is given.")] = False,
    scale_to_robot: Scaled = False,
    spec: Annotated[
        Path | None,
        typer.Option(help="Experiment file to run; only --out and --jobs can be combined with it.", show_default=False),
    ] = None,
    **values: str | None,
) -> None:
    """Compare controllers on trajectories. Options with several values accept a list separated by commas.

    With --config, --set or --models, only mpc is run by default, with the models of these options.

    If a run of the predictive controller is not completed, the exit code is 1; the report is written nevertheless.
    """
    from diffdrive_mpc.bench.comparison.plan import read_options  # noqa: PLC0415 - --help does not need it
    from diffdrive_mpc.bench.comparison.results import describe_incomplete  # noqa: PLC0415
    from diffdrive_mpc.bench.comparison.study import ComparisonStudy  # noqa: PLC0415
    from diffdrive_mpc.bench.study import carry_out  # noqa: PLC0415

    if spec is not None:
        from diffdrive_mpc.bench.spec import SpecStudy, load_experiment  # noqa: PLC0415

        if any((config, settings, horizons, sweeps, quick, scale_to_robot, *values.values())):
            raise ValueError("--spec: the file defines the runs; only --out and --jobs can be combined with the option")
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
    failure = describe_incomplete(carry_out(ComparisonStudy(request), out or Path(_BENCH_OUT), jobs))
    if failure:
        echo(f"error: {failure}", err=True)
        raise typer.Exit(FAILED)
