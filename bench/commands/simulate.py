"""`diffdrive-mpc simulate`: run one case, show it, draw it, log it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from diffdrive_mpc.bench.commands.options import ConfigFile
from diffdrive_mpc.bench.commands.out_folder import out_folder

EXAMPLE = "Example: diffdrive-mpc simulate --model ssm --trajectory square --set horizon=20 --out results"


def simulate(
    *,
    trajectory: Annotated[str, typer.Option(help="circle, square, s, cane, or the path of a file.")] = "circle",
    model: Annotated[
        str | None,
        typer.Option(help="Velocity model: mbm, sm, ssm, or the path of a file.", show_default="ssm, or --config's"),
    ] = None,
    controller: Annotated[str, typer.Option(help="mpc, or the peer kanayama.")] = "mpc",
    plant: Annotated[str, typer.Option(help="mujoco, model:NAME, or model:NAME+DEAD_TIME.")] = "mujoco",
    surface: Annotated[str, typer.Option(help="Floor of the mujoco plant, slip of a model: plant.")] = "default",
    sensors: Annotated[str, typer.Option(help="Sensor set.")] = "default",
    scenario: Annotated[
        str, typer.Option(help="What happens to the robot: none, push, ..., or the path of a file.")
    ] = "none",
    seed: Annotated[int, typer.Option(min=0, help="Seed of the noise; the same seed gives the same run.")] = 0,
    config: ConfigFile = None,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Replace a configuration value; repeatable."),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(parser=out_folder, metavar="PATH", help="Folder for figures.", show_default=False)
    ] = None,
    log: Annotated[Path | None, typer.Option(help="CSV file for the log of the run.", show_default=False)] = None,
) -> None:
    """Run one closed loop and print how well it tracked; --out draws it, --log writes it as CSV."""
    from diffdrive_mpc.bench.simulate import simulate_one  # noqa: PLC0415 - --help and other commands do without it

    simulate_one(
        controller=controller,
        model=model,
        trajectory=trajectory,
        plant=plant,
        surface=surface,
        sensors=sensors,
        scenario=scenario,
        seed=seed,
        config=config,
        settings=settings or [],
        out=out,
        log=log,
    )
