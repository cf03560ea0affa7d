"""Commands of packages, and options that several commands share."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer


@dataclass(frozen=True)
class PluggedCommand:
    """A command that a package registers as an entry point of the group `diffdrive_mpc.commands`.

    Its module is imported for `diffdrive-mpc --help`, so its top imports only the dependencies of the options.

    Attributes
    ----------
    panel
        Heading of the command in `diffdrive-mpc --help`.
    run
        Function whose parameters are the options, and whose docstring is the help text.
    example
        Last line of the help text.
    passed_on
        True if the command accepts words that are no options of it, such as words after `--ros-args`.
    """

    panel: str
    run: Callable[..., None]
    example: str
    passed_on: bool = False


# Options that commands and studies share, each declared once.


def out_folder(text: str) -> Path:
    """Parse the folder of `--out`; raise typer.BadParameter if it is empty, which would mean the current folder."""
    if not text.strip():
        raise typer.BadParameter("it is empty; give a folder, '.' for the current one")
    return Path(text)


def out_option(content: str, usual: str | None = None) -> Any:  # noqa: ANN401 - typer's own type
    """Create the option of a folder for `content`; `usual` is the default that the help text shows."""
    default: str | bool = usual or False
    return typer.Option("--out", parser=out_folder, metavar="PATH", help=f"Folder for {content}.", show_default=default)


def file_option(content: str, name: str) -> Any:  # noqa: ANN401 - typer's own type
    """Create the option of a YAML file that replaces a shipped one."""
    return typer.Option(name, help=f"{content} (YAML) in place of the shipped one.", show_default=False)


Jobs = Annotated[int | None, typer.Option("--jobs", min=1, help="Processes.", show_default="one for each core")]
