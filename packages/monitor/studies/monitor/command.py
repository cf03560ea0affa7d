"""Command `python -m studies monitor`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from diffdrive_mpc.app.command_line.options import Jobs, out_option

EXAMPLE = "Example: python -m studies monitor --out watched --seeds 2 --hours 0.2"


def run(
    *,
    out: Annotated[Path, out_option("monitor.md, monitor.json and figures/", "out/monitor")] = Path("out/monitor"),
    rules: Annotated[
        str, typer.Option(metavar="NAME|FILE", help="Rules: a shipped name, or the path of a YAML file.")
    ] = "default",
    seeds: Annotated[int, typer.Option(min=1, max=1000, help="Drives of each fault.")] = 20,
    hours: Annotated[float, typer.Option(min=0.01, max=1000, help="Hours of nominal drives.")] = 10.0,
    tuning: Annotated[bool, typer.Option("--tuning", help="Use the seeds on which the rules were tuned.")] = False,
    jobs: Jobs = None,
) -> None:
    """Test the monitor on faulty controllers, and on hours of drives without a fault.

    The report contains detected and missed faults and the detection times. The exit code is 1 if a fault was missed or
    detected late, or if there was a false alarm; the report is written in all cases.
    """
    from studies.monitor.study import MonitorStudy, complaint  # noqa: PLC0415

    from diffdrive_mpc.app.command_line.one_line_errors import FAILED  # noqa: PLC0415 - --help does not need it
    from diffdrive_mpc.bench.study import carry_out  # noqa: PLC0415

    problem = complaint(carry_out(MonitorStudy(rules, seeds, hours, tuning=tuning), out, jobs))
    if problem:
        typer.echo(f"error: {problem}", err=True)
        raise typer.Exit(FAILED)
