"""`diffdrive-mpc excite`: an optimised drive for the identification of slip or of a model."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from diffdrive_mpc.app.command_line.echo import echo
from diffdrive_mpc.app.command_line.options import PluggedCommand

_SLIP, _MODEL = "slip", "model"
_SIDE, _SLIP_SECONDS, _SECONDS = 6.0, 90.0, 60.0


def excite(
    *,
    config: Annotated[
        str | None,
        typer.Argument(
            help="For a model: configuration of the controller; a file, or mbm, sm, ssm.",
            show_default="ssm",
        ),
    ] = None,
    out: Annotated[Path, typer.Option(help="Trajectory file to write.", show_default=False)],
    purpose: Annotated[str, typer.Option("--for", help="Purpose of the identification: slip or model.")] = _SLIP,
    side: Annotated[
        float | None,
        typer.Option(
            help="For slip: side of the square around the start that the drive stays in [m].",
            show_default=f"{_SIDE:g}",
        ),
    ] = None,
    inside: Annotated[
        str | None,
        typer.Option(
            metavar="LxW",
            help="For a model: length and width of the room [m]; the drive starts in the middle, along the length.",
            show_default=False,
        ),
    ] = None,
    seconds: Annotated[
        float | None,
        typer.Option(
            help="Approximate duration of the drive [s].", show_default=f"{_SLIP_SECONDS:g}; {_SECONDS:g} for a model"
        ),
    ] = None,
    speed: Annotated[float, typer.Option(help="Maximum speed [m/s].")] = 0.6,
    yaw_rate: Annotated[float, typer.Option(help="Maximum yaw rate [rad/s].")] = 1.0,
    log: Annotated[
        Path | None,
        typer.Option(help="For a model: log of the drive on --plant (.csv, .mcap).", show_default=False),
    ] = None,
    plant: Annotated[str, typer.Option(help="With --log: plant, as for simulate.")] = "mujoco",
    seed: Annotated[int, typer.Option(min=0, help="For a model: seed of the search and of the noise.")] = 0,
) -> None:
    """Write an excitation trajectory for identification, for `simulate --trajectory` and the node.

    A slip trajectory separates the terms of the slip law. A model trajectory maximises the information about gains,
    lags and dead times (D-optimal design) over piecewise-constant twists and sums of sines; the command prints the
    expected accuracy of these parameters.
    """
    from diffdrive_mpc.models.checked_yaml import ConfigError  # noqa: PLC0415 - --help does not need it

    if purpose not in (_SLIP, _MODEL):
        raise ConfigError(f"--for {purpose}: give {_SLIP} or {_MODEL}")
    if out.suffix not in (".yaml", ".yml"):
        raise ConfigError(f"--out {out}: give a file name that ends in .yaml or .yml")
    others = {"--side": side} if purpose == _MODEL else {"CONFIG": config, "--inside": inside, "--log": log}
    unsuitable = [name for name, value in others.items() if value is not None]
    if unsuitable:
        raise ConfigError(f"{unsuitable[0]} is not an option of --for {purpose}; omit it")
    if purpose == _SLIP:
        from diffdrive_mpc_extras.excitation.slip_excitation import slip_excitation, write_slip_drive  # noqa: PLC0415

        side, seconds = _SIDE if side is None else side, _SLIP_SECONDS if seconds is None else seconds
        segments = slip_excitation(side, seconds, speed, yaw_rate)
        echo(write_slip_drive(out, segments))
        return
    if inside is None:
        raise ConfigError(f"--for {_MODEL} needs --inside, the length and width of the room [m], such as --inside 4x3")
    from diffdrive_mpc_extras.excitation.excite import excite_into  # noqa: PLC0415
    from diffdrive_mpc_extras.excitation.model_excitation import Room  # noqa: PLC0415

    motion = {"seconds": _SECONDS if seconds is None else seconds, "speed": speed, "yaw_rate": yaw_rate}
    excite_into(config or "ssm", Room.read(inside), out, seed=seed, log=log, plant=plant, **motion)


EXCITE = PluggedCommand(
    "Your robot",
    excite,
    "Example: diffdrive-mpc excite ssm --for model --inside 4x3 --seconds 60 --out drive.yaml",
)
