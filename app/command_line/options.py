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
        Heading below which `diffdrive-mpc --help` lists it.
    run
        Function whose parameters are its options and whose docstring is its help.
    example
        Last line of its help.
    passed_on
        True if it receives the words that are not its options, such as those after `--ros-args`.
    """

    panel: str
    run: Callable[..., None]
    example: str
    passed_on: bool = False


# Options that commands and studies share, each declared once.


def out_folder(text: str) -> Path:
    """Read the folder of `--out`; raises typer.BadParameter when it is empty, which would be the current folder."""
    if not text.strip():
        raise typer.BadParameter("it is empty; give a folder, '.' for the current one")
    return Path(text)


def out_option(content: str, usual: str | None = None) -> Any:  # noqa: ANN401 - typer's own type
    """Create the option that names a folder for `content`, with its default if it has one."""
    shown: str | bool = usual or False
    return typer.Option("--out", parser=out_folder, metavar="PATH", help=f"Folder for {content}.", show_default=shown)


def file_option(content: str, name: str) -> Any:  # noqa: ANN401 - typer's own type
    """Create the option that takes a YAML file in place of a shipped one."""
    return typer.Option(name, help=f"{content} (YAML) in place of the shipped one.", show_default=False)


Jobs = Annotated[int | None, typer.Option("--jobs", min=1, help="Processes.", show_default="one for each core")]
