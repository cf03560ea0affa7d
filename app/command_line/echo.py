"""Print a line: names in it come from files, and files from anybody, so that no text may steer the terminal."""

from __future__ import annotations

import typer

from diffdrive_mpc.models.table import plain_text


def echo(text: object = "", *, nl: bool = True, err: bool = False) -> None:
    """Print `text` to stdout or with `err` to stderr; characters that cannot be printed stand as escapes.

    `nl` ends it with a new line.
    """
    typer.echo(plain_text(str(text)), nl=nl, err=err)
