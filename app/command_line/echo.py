"""Print a line: names in it may come from untrusted files, so control characters are escaped."""

from __future__ import annotations

import typer

from diffdrive_mpc.models.table import plain_text


def echo(text: object = "", *, nl: bool = True, err: bool = False) -> None:
    """Print `text` to stdout or with `err` to stderr; characters that cannot be printed are escaped.

    `nl` appends a line feed.
    """
    typer.echo(plain_text(str(text)), nl=nl, err=err)
