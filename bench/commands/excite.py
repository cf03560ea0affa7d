"""`diffdrive-mpc excite`: a drive that is worth learning from."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

EXAMPLE = "Example: diffdrive-mpc excite --for slip --side 5 --out slip_drive.yaml"


def excite(
    *,
    out: Annotated[Path, typer.Option(help="Trajectory file to write.", show_default=False)],
    purpose: Annotated[str, typer.Option("--for", help="What it is to tell: slip.")] = "slip",
    side: Annotated[
        float, typer.Option(help="Side of the square that it stays in; it begins in the middle [m].")
    ] = 6.0,
    seconds: Annotated[float, typer.Option(help="How long it lasts, about [s].")] = 90.0,
    speed: Annotated[float, typer.Option(help="Largest speed [m/s].")] = 0.6,
    yaw_rate: Annotated[float, typer.Option(help="Largest yaw rate [rad/s].")] = 1.0,
) -> None:
    """Write a trajectory that tells the terms of slip apart, for `simulate --trajectory` and the node."""
    from diffdrive_mpc.models.checked_yaml import ConfigError  # noqa: PLC0415 - --help does without it
    from diffdrive_mpc.mpc.trajectories.excitation import slip_excitation, told_apart, write_excitation  # noqa: PLC0415

    if purpose != "slip":
        raise ConfigError(f"--for {purpose}: there is a drive for slip only; give --for slip")
    segments = slip_excitation(side, seconds, speed, yaw_rate)
    write_excitation(out, segments)
    told = told_apart(segments)
    typer.echo(
        f"{out}: {len(segments)} twists, {sum(one.duration for one in segments):.0f} s without the time to change "
        f"between them. Terms in v, omega and v omega: the two least apart correlate by {told:.2f} (1: not apart)."
    )
