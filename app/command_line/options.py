"""Commands of packages, and options of several commands."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer


@dataclass(frozen=True)
class PluggedCommand:
    """Command that a package registers as an entry point of the group `diffdrive_mpc.commands`.

    The module of the command is imported for `diffdrive-mpc --help`, so its top-level imports must be limited to those
    that the options need.

    Attributes
    ----------
    panel
        Heading of the command in `diffdrive-mpc --help`.
    run
        Function whose parameters are the options and whose docstring is the help text.
    example
        Last line of the help text.
    passed_on
        True if the command accepts unknown arguments, such as those after `--ros-args`.
    """

    panel: str
    run: Callable[..., None]
    example: str
    passed_on: bool = False


# Common options of commands and studies.


def out_folder(text: str) -> Path:
    """Parse the folder of `--out`; raise typer.BadParameter if `text` is empty, as Path("") is the current folder."""
    if not text.strip():
        raise typer.BadParameter("empty; use '.' for the current folder")
    return Path(text)


def out_option(content: str, usual: str | None = None) -> Any:  # noqa: ANN401 - typer's own type
    """Create the option for the folder of `content`; `usual` is the default value that the help text states."""
    default: str | bool = usual or False
    return typer.Option("--out", parser=out_folder, metavar="PATH", help=f"Folder for {content}.", show_default=default)


def file_option(content: str, name: str) -> Any:  # noqa: ANN401 - typer's own type
    """Create the option `name` for a YAML file that replaces a built-in file; `content` describes the file."""
    return typer.Option(name, help=f"{content} (YAML) in place of the built-in file.", show_default=False)


Jobs = Annotated[int | None, typer.Option("--jobs", min=1, help="Processes.", show_default="one for each core")]
