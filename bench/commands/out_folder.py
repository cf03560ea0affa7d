"""The option that names a folder for results."""

from __future__ import annotations

from pathlib import Path

import typer


def out_folder(text: str) -> Path:
    """Read the folder of `--out`; raises typer.BadParameter when it is empty, which would be the current folder."""
    if not text.strip():
        raise typer.BadParameter("it is empty; give a folder, '.' for the current one")
    return Path(text)
