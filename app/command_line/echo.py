"""Output of text with escaped control characters, because names may come from untrusted files."""

from __future__ import annotations

import typer

from diffdrive_mpc.models.table import plain_text


def echo(text: object = "", *, nl: bool = True, err: bool = False) -> None:
    """Print `text` to stdout, or to stderr if `err`; escape control characters.

    If `nl`, append a line feed.
    """
    typer.echo(plain_text(str(text)), nl=nl, err=err)
