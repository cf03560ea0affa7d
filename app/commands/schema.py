"""`diffdrive-mpc schema`: what a kind of file may hold, as JSON Schema for editors and other tools."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from diffdrive_mpc.app.command_line.completion import choices
from diffdrive_mpc.app.command_line.echo import echo

SCHEMA_EXAMPLE = "Example: diffdrive-mpc schema trajectory --out trajectory.schema.json"


def schema(
    kind: Annotated[
        str | None,
        typer.Argument(
            metavar="KIND",
            help="Kind of file.",
            show_default="list the kinds",
            autocompletion=choices("schema"),
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write the schema here.", show_default="standard output")
    ] = None,
    path: Annotated[bool, typer.Option("--path", help="Print where the installed schema lies, for editors.")] = False,
) -> None:
    """Print the JSON Schema of a kind of file.

    With a first line `# yaml-language-server: $schema=FILE` in a YAML file, editors complete and check its keys.
    """
    from diffdrive_mpc.app.command_line.file_kinds import kind_of  # noqa: PLC0415 - --help does without it
    from diffdrive_mpc.models.checked_yaml import ConfigError  # noqa: PLC0415
    from diffdrive_mpc.models.whole_file import whole_file  # noqa: PLC0415

    if kind is None:
        if out is not None or path:
            raise ConfigError("which schema? name a kind: diffdrive-mpc schema lists them")
        _list_kinds()
        return
    from diffdrive_mpc.app.schemas.generate import placed, schema_text  # noqa: PLC0415 - the list does without it

    described = kind_of(kind)
    if out is not None and path:
        raise ConfigError("--path names a file that is there already; give --path or --out")
    if path:
        echo(placed(described))
    elif out is None:
        echo(schema_text(described), nl=False)
    else:
        with whole_file(out) as draft:
            draft.write_text(schema_text(described), encoding="utf-8")


def _list_kinds() -> None:
    from diffdrive_mpc.app.command_line.file_kinds import KINDS  # noqa: PLC0415
    from diffdrive_mpc.bench.progress import output_console  # noqa: PLC0415
    from diffdrive_mpc.bench.table import Table  # noqa: PLC0415

    rows = tuple((kind.name, kind.what, kind.given, str(len(kind.files))) for kind in KINDS.values())
    table = Table("Kinds of files with a schema", ("kind", "what it says", "given as", "shipped"), rows, text_columns=3)
    output_console().print(table.rich())
