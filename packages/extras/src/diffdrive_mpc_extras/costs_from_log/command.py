"""`diffdrive-mpc torque`: energy costs of a robot's turns, identified from a log."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from diffdrive_mpc.app.command_line.options import PluggedCommand, out_option


def torque(
    *,
    log: Annotated[Path, typer.Option(help="Log with readings of the battery and the motor currents.")],
    vehicle: Annotated[
        str,
        typer.Option(metavar="NAME|FILE", help="Vehicle: weight, dimensions and torque limit (YAML)."),
    ],
    out: Annotated[Path, out_option("drive.yaml, turn-costs.yaml, report.html, torque.json, torque.md and figures/")],
    mapping: Annotated[
        str | None,
        typer.Option(help="Mapping of the log's columns or topics (YAML).", show_default=False),
    ] = None,
    drive: Annotated[
        str | None,
        typer.Option(metavar="NAME|FILE", help="Initial drive constants (YAML).", show_default=False),
    ] = None,
) -> None:
    """Identify the energy costs of a robot's turns from its log: drive constants, torque curves and slip law."""
    from diffdrive_mpc.bench.study import carry_out  # noqa: PLC0415 - --help does not need it
    from diffdrive_mpc_extras.costs_from_log.study import TorqueLogStudy  # noqa: PLC0415

    carry_out(TorqueLogStudy(log, mapping, vehicle, drive), out, jobs=1)


TORQUE = PluggedCommand(
    "Your robot",
    torque,
    "Example: diffdrive-mpc torque --log drive.csv --vehicle fsu_bot --out from-log",
)
