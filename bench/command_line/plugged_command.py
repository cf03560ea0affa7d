"""A command that a plug-in adds to the command line."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True)
class PluggedCommand:
    """One command.

    Attributes
    ----------
    panel
        Under which `diffdrive-mpc --help` shows it.
    name
        What is typed.
    run
        The function whose parameters are its options; it imports what it needs when it runs.
    example
        The last line of its help.
    """

    panel: str
    name: str
    run: Callable[..., None]
    example: str
