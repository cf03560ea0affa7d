"""`diffdrive-mpc excite`: a drive with much information on slip or on a model."""

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
            help="For the model: configuration of the controller that drives it, a file, or mbm, sm, ssm.",
            show_default="ssm",
        ),
    ] = None,
    out: Annotated[Path, typer.Option(help="Trajectory file to write.", show_default=False)],
    purpose: Annotated[str, typer.Option("--for", help="What it is to tell: slip, or model.")] = _SLIP,
    side: Annotated[
        float | None,
        typer.Option(
            help="For slip: side of the square that it stays in; it begins in the middle [m].",
            show_default=f"{_SIDE:g}",
        ),
    ] = None,
    inside: Annotated[
        str | None,
        typer.Option(
            metavar="LxW",
            help="For the model: room that it stays in [m]; it begins in the middle, the length ahead.",
            show_default=False,
        ),
    ] = None,
    seconds: Annotated[
        float | None,
        typer.Option(
            help="How long it lasts, about [s].", show_default=f"{_SLIP_SECONDS:g}; {_SECONDS:g} for the model"
        ),
    ] = None,
    speed: Annotated[float, typer.Option(help="Largest speed [m/s].")] = 0.6,
    yaw_rate: Annotated[float, typer.Option(help="Largest yaw rate [rad/s].")] = 1.0,
    log: Annotated[
        Path | None, typer.Option(help="For the model: drive it, and write this log (.csv, .mcap).", show_default=False)
    ] = None,
    plant: Annotated[str, typer.Option(help="With --log: the robot, as for simulate.")] = "mujoco",
    seed: Annotated[int, typer.Option(min=0, help="For the model: of the search, and of the noise.")] = 0,
) -> None:
    """Write a trajectory that is worth learning from, for `simulate --trajectory` and the node.

    For slip it separates the slip's terms. For the model it contains the most information about gains, lags and dead
    times: of held moves and of sums of sines the ones with the largest information (D-optimal), and how well these will
    be known.
    """
    from diffdrive_mpc.models.checked_yaml import ConfigError  # noqa: PLC0415 - --help does without it

    if purpose not in (_SLIP, _MODEL):
        raise ConfigError(f"--for {purpose}: give {_SLIP} or {_MODEL}")
    others = {"--side": side} if purpose == _MODEL else {"CONFIG": config, "--inside": inside, "--log": log}
    unsuitable = [name for name, value in others.items() if value is not None]
    if unsuitable:
        raise ConfigError(f"{unsuitable[0]} does not go with --for {purpose}; leave it out")
    if purpose == _SLIP:
        from diffdrive_mpc_extras.excitation.slip_excitation import slip_excitation, write_slip_drive  # noqa: PLC0415

        segments = slip_excitation(side or _SIDE, seconds or _SLIP_SECONDS, speed, yaw_rate)
        echo(write_slip_drive(out, segments))
        return
    if inside is None:
        raise ConfigError(f"--for {_MODEL} needs --inside, the room in metres, such as --inside 4x3")
    from diffdrive_mpc_extras.excitation.excite import excite_into  # noqa: PLC0415
    from diffdrive_mpc_extras.excitation.model_excitation import Room  # noqa: PLC0415

    motion = {"seconds": seconds or _SECONDS, "speed": speed, "yaw_rate": yaw_rate}
    excite_into(config or "ssm", Room.read(inside), out, seed=seed, log=log, plant=plant, **motion)


EXCITE = PluggedCommand(
    "Your robot",
    excite,
    "Example: diffdrive-mpc excite ssm --for model --inside 4x3 --seconds 60 --out drive.yaml",
)
