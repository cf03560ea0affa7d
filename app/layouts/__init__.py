"""Layouts for the programs that open logs: Foxglove and PlotJuggler."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path

from diffdrive_mpc.bench.report_folder import staged

LAYOUTS = ("foxglove.json", "plotjuggler.xml")
"""The files."""


def layout(name: str) -> str:
    """The text of one of `LAYOUTS`."""
    return files(__package__).joinpath(name).read_text(encoding="utf-8")


def write_layouts(folder: Path) -> list[Path]:
    """Write them into a folder; returns where they are. Raises ConfigError if it cannot be written to."""
    with staged(folder, files=LAYOUTS) as draft:
        for name in LAYOUTS:
            (draft / name).write_text(layout(name), encoding="utf-8")
    return [folder / name for name in LAYOUTS]
