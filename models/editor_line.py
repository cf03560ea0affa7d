"""The first line of a YAML file, by which editors find its schema."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

EDITOR_LINE = "# yaml-language-server: $schema="
"""How it begins; after it the place of the schema, from the folder of the file."""


def kept_editor_line(path: Path) -> str:
    """That line of the file at `path` for one that takes its place; nothing where there is none."""
    with suppress(OSError, UnicodeDecodeError), path.open(encoding="utf-8") as file:
        first = file.readline()
        return first if first.startswith(EDITOR_LINE) else ""
    return ""
