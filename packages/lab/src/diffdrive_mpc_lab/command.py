"""Command `lab`: write the laboratory as one page."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from diffdrive_mpc.app.command_line.options import PluggedCommand


def lab(
    *,
    out: Annotated[Path, typer.Option("--out", help="File of the page.")] = Path("out/lab.html"),
) -> None:
    """Write the browser laboratory: one page with the compiled controller; it needs no network and no installation."""
    from diffdrive_mpc.app.command_line.echo import echo  # noqa: PLC0415 - --help needs none of these
    from diffdrive_mpc.models.whole_file import whole_file  # noqa: PLC0415
    from diffdrive_mpc_lab.build import has_compiler, page_text  # noqa: PLC0415

    with whole_file(out, begins=b"<!DOCTYPE html>") as draft:
        if has_compiler():
            echo("compiling the controller to WebAssembly, about 20 s")
        size = draft.write_text(page_text(), encoding="utf-8")
    echo(f"{out}: {size / 1e6:.2f} MB")


LAB = PluggedCommand("Drive", lab, "Example: diffdrive-mpc lab --out out/lab.html")
