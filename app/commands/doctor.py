"""`diffdrive-mpc doctor`: what is there on this computer, and what it means."""

from __future__ import annotations

from typing import Annotated

import typer

from diffdrive_mpc.bench.command_line.one_line_errors import FAILED

EXAMPLE = "Example: diffdrive-mpc doctor"


def doctor(
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON, for programs.")] = False,
) -> None:
    """Look at this computer for three seconds: what is there, what it means, and what to do.

    Paste its answer when you ask for help. The exit code is 1 only where the controller itself cannot run.
    """
    from diffdrive_mpc.app.doctor import examination  # noqa: PLC0415 - --help does without it
    from diffdrive_mpc.bench.progress import output_console  # noqa: PLC0415

    found = examination.examine()
    if as_json:
        typer.echo(examination.as_json(found))
    else:
        console = output_console()
        console.print(examination.heading(), markup=False, highlight=False)
        for table in examination.tables(found):
            typer.echo()
            console.print(table.rich())
    if not examination.can_run(found):
        raise typer.Exit(FAILED)
