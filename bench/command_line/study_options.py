"""Options that commands and studies share, each declared once."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer


def out_folder(text: str) -> Path:
    """Read the folder of `--out`; raises typer.BadParameter when it is empty, which would be the current folder."""
    if not text.strip():
        raise typer.BadParameter("it is empty; give a folder, '.' for the current one")
    return Path(text)


def out_option(what: str, usual: str | None = None) -> Any:  # noqa: ANN401 - typer's own type
    """The option that names a folder for `what`, and the usual one where it need not be given."""
    shown: str | bool = usual or False
    return typer.Option("--out", parser=out_folder, metavar="PATH", help=f"Folder for {what}.", show_default=shown)


def parts_option(parts: str) -> Any:  # noqa: ANN401 - typer's own type
    """The option that chooses some parts of a study."""
    return typer.Option("--only", metavar="PARTS", help=f"{parts}.", show_default="all of them")


def file_option(what: str, name: str) -> Any:  # noqa: ANN401 - typer's own type
    """The option that takes a YAML file in place of a shipped one."""
    return typer.Option(name, help=f"{what} (YAML) in place of the shipped one.", show_default=False)


Jobs = Annotated[int | None, typer.Option("--jobs", min=1, help="Processes.", show_default="one for each core")]
