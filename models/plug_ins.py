"""Plug-ins: parts that nobody imports by name. What they register is found here, and imported when it is asked for.

A distribution registers in its `pyproject.toml`, this project's own parts in `extras/` as anybody's:

    [project.entry-points."diffdrive_mpc.structures"]
    mine = "my_package.my_structure:STRUCTURE"

Groups: `structures` (`models.function_structure.FunctionStructure`), `files` (`models.file_kind.FileKind`), `commands`
(`bench.command_line.options.PluggedCommand`).
"""

from __future__ import annotations

from functools import cache
from importlib.metadata import entry_points
from typing import Any


@cache
def plug_ins(group: str) -> tuple[Any, ...]:
    """What is registered in a group, in the order of the names; a part that was taken out is left out.

    Raises
    ------
    ImportError
        If a part is there and lacks a module that it needs.
    """
    parts = []
    for entry in sorted(entry_points(group=f"diffdrive_mpc.{group}"), key=lambda entry: entry.name):
        try:
            parts.append(entry.load())
        except ModuleNotFoundError as error:
            if error.name is None or not f"{entry.module}.".startswith(f"{error.name}."):
                raise
    return tuple(parts)
