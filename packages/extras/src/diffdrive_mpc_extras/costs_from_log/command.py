"""`diffdrive-mpc torque`: energy costs of a robot's turns, from a log of it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from diffdrive_mpc.app.command_line.options import PluggedCommand, out_option


def torque(
    *,
    log: Annotated[Path, typer.Option(help="Log of a robot whose battery and motors are logged.")],
    vehicle: Annotated[
        str,
        typer.Option(metavar="NAME|FILE", help="Its weight, lengths and torque limit (YAML)."),
    ],
    out: Annotated[Path, out_option("drive.yaml, turn-costs.yaml, report.html, torque.json, torque.md and figures/")],
    mapping: Annotated[
        str | None,
        typer.Option(help="What its columns or topics are.", show_default=False),
    ] = None,
    drive: Annotated[
        str | None,
        typer.Option(metavar="NAME|FILE", help="Drive constants to begin with (YAML).", show_default=False),
    ] = None,
) -> None:
    """Identify the energy costs of a robot's turns from its log: drive constants, torque curves and slip law."""
    from diffdrive_mpc.bench.study import carry_out  # noqa: PLC0415 - --help does without it
    from diffdrive_mpc_extras.costs_from_log.study import TorqueLogStudy  # noqa: PLC0415

    carry_out(TorqueLogStudy(log, mapping, vehicle, drive), out, jobs=1)


TORQUE = PluggedCommand(
    "Your robot",
    torque,
    "Example: diffdrive-mpc torque --log drive.csv --vehicle fsu_bot --out from-log",
)
