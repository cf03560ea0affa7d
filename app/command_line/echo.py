"""Output of text with escaped control characters, because names may come from untrusted files."""

from __future__ import annotations

import re
import shutil
import sys
import textwrap

import typer

from diffdrive_mpc.models.table import plain_text


def echo(text: object = "", *, nl: bool = True, err: bool = False) -> None:
    """Print `text` to stdout, or to stderr if `err`; escape control characters.

    If `nl`, append a line feed. A terminal gets errors, warnings and notes wrapped at its width.
    """
    shown = plain_text(str(text))
    if (sys.stderr if err else sys.stdout).isatty():
        shown = _FINDING.sub(_wrapped, shown)
    typer.echo(shown, nl=nl, err=err)


_FINDING = re.compile(r"^(?:error|warning|note): .*$", re.MULTILINE)


def _wrapped(line: re.Match[str]) -> str:
    width = shutil.get_terminal_size().columns
    return textwrap.fill(line[0], width, subsequent_indent="  ", break_long_words=False, break_on_hyphens=False)
