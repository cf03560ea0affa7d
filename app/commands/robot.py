"""`diffdrive-mpc identify`: identify a model and its uncertainty from logs of a robot."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from diffdrive_mpc.app.command_line.options import out_folder
from diffdrive_mpc.app.commands.options import Mapping, RobotName

IDENTIFY_EXAMPLE = "Example: diffdrive-mpc identify drive.csv --structure sm --out my_robot"
_DEFAULT_OUT = "identified"


def identify(
    *,
    logs: Annotated[list[Path], typer.Argument(metavar="LOG...", help="CSV or MCAP files, or ROS 2 bags.")],
    structure: Annotated[
        str,
        typer.Option(help="mbm, mbm_modes, sm, ssm, two_delays, p2_experimental, p2_physical; networks lstm, hybrid."),
    ] = "sm",
    mapping: Mapping = None,
    out: Annotated[
        Path | None,
        typer.Option(
            parser=out_folder,
            metavar="PATH",
            help="Folder of the model, the configuration and the report.",
            show_default=_DEFAULT_OUT,
        ),
    ] = None,
    validate: Annotated[
        list[Path] | None,
        typer.Option(metavar="LOG", help="Log for validation; repeatable.", show_default="a share of each log"),
    ] = None,
    fit_share: Annotated[
        float | None,
        typer.Option(help="Share of each log used for identification; the rest is for validation.", show_default="0.6"),
    ] = None,
    order: Annotated[str, typer.Option(metavar="auto|N", help="Order of an ssm, 1 to 5.")] = "auto",
    effects: Annotated[
        bool, typer.Option("--effects", help="Also identify effects missing in an sm: slew rate, steps, tyres, veer.")
    ] = False,
    packages: Annotated[
        str | None,
        typer.Option(
            "--for",
            metavar="NAMES",
            help="Also write parameters for nav2, ros2_control or robot_localization; names separated by commas.",
            show_default="none",
        ),
    ] = None,
    name: Annotated[str | None, typer.Option(help="Name of the model.", show_default="from the logs")] = None,
    robot: RobotName = None,
    draft_mapping: Annotated[
        bool, typer.Option("--draft-mapping", help="Only write a draft of the mapping of LOG (mapping.yaml).")
    ] = False,
    force: Annotated[
        bool, typer.Option("--force", help="Write model and configuration despite errors in logs or a low FIT.")
    ] = False,
) -> None:
    """Identify a velocity model from logs and write the model, a configuration, a report and figures."""
    if draft_mapping:
        from diffdrive_mpc.app.identification.study import write_draft  # noqa: PLC0415

        write_draft(logs, out)
        return
    from diffdrive_mpc.app.identification.study import identify_into  # noqa: PLC0415 - --help does not need it

    identify_into(
        logs,
        out or Path(_DEFAULT_OUT),
        structure=structure,
        mapping=mapping,
        validate=validate or [],
        fit_share=fit_share,
        order=order,
        effects=effects,
        name=name,
        robot=robot,
        packages=packages,
        force=force,
    )
