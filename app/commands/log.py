"""`diffdrive-mpc log`: check logs of drives."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from diffdrive_mpc.app.command_line.echo import echo
from diffdrive_mpc.app.command_line.groups import PackagedGroup
from diffdrive_mpc.app.command_line.one_line_errors import FAILED
from diffdrive_mpc.app.commands.options import Mapping

log_app = typer.Typer(
    cls=PackagedGroup, no_args_is_help=True, rich_markup_mode=None, help="Check and replay logs of drives."
)


@log_app.callback()
def _log() -> None:
    """Check and replay logs of drives."""


@log_app.command(epilog="Example: diffdrive-mpc log check drive.mcap")
def check(
    log: Annotated[Path, typer.Argument(metavar="LOG", help="CSV file, or ROS 2 bag.")], *, mapping: Mapping = None
) -> None:
    """Check a log for errors in the data and for sensors that are reversed, swapped, scaled, rotated or delayed.

    The last line contains the sensor settings for a configuration. The exit code is 1 if a model must not be identified
    from the data because of errors.
    """
    import yaml  # noqa: PLC0415 - --help does not need these modules

    from diffdrive_mpc.models.identification.fit.sensors import find_corrections  # noqa: PLC0415
    from diffdrive_mpc.models.logs import read_log  # noqa: PLC0415
    from diffdrive_mpc.models.logs.diagnosis import summary  # noqa: PLC0415
    from diffdrive_mpc.models.logs.record import format_labelled_findings  # noqa: PLC0415

    content = read_log(log, mapping)
    corrections = find_corrections(content.name, content.records, mapping)
    findings = corrections.merged(content.findings)
    echo("\n".join([*summary(content), *format_labelled_findings(findings)]))
    sensor_settings = yaml.safe_dump({"sensors": corrections.settings}, default_flow_style=None, sort_keys=False)
    if content.errors:
        conclusion = "unknown until the errors are corrected"
    elif any(finding.changes and finding.severity == "warning" for finding in findings):
        conclusion = "unknown until the mapping is corrected as proposed"
    elif any(finding.severity == "warning" for finding in findings):
        conclusion = "no setting corrects the warnings above"
    else:
        conclusion = "no correction needed"
    is_known = corrections.settings and not conclusion.startswith("unknown")
    echo(sensor_settings.rstrip() if is_known else f"sensors: {conclusion}")
    if content.errors:
        raise typer.Exit(FAILED)
