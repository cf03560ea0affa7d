"""The console that results are printed on."""

from __future__ import annotations

from rich.console import Console


def output_console(width_elsewhere: int = 140) -> Console:
    """Console on stdout; where that is no terminal (a file, a pipe, a build log) it is wide enough for the tables."""
    console = Console()
    return console if console.is_terminal else Console(width=width_elsewhere)
