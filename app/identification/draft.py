"""The draft of a mapping as a file, and what reading the log with it finds."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path

import typer

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.logs.draft_mapping import draft_mapping
from diffdrive_mpc.models.logs.reading import read_log

_NAME = "mapping.yaml"


def write_draft(logs: Sequence[Path], out: Path | None) -> None:
    """Write a draft of the mapping of one log, read the log with it, and print what that finds.

    Parameters
    ----------
    logs
        One CSV file or bag.
    out
        The file, if it ends in .yaml, or a folder for mapping.yaml; None for the current folder.

    Raises
    ------
    models.checked_yaml.ConfigError
        If there are several logs, the log cannot be read, or the file exists or cannot be written.
    """
    if len(logs) != 1:
        raise ConfigError(f"--draft-mapping: {len(logs)} logs; give one, the mapping then serves all of its kind")
    target = Path(_NAME) if out is None else out if out.suffix in (".yaml", ".yml") else out / _NAME
    text = draft_mapping(logs[0])
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with target.open("x", encoding="utf-8") as file:
            file.write(text)
    except FileExistsError as error:
        raise ConfigError(f"{target}: exists and is not replaced; move it away, or give --out FILE.yaml") from error
    except OSError as error:
        raise ConfigError(f"{target}: cannot be written ({error.strerror})") from error
    typer.echo(f"{target}: guesses with their reasons; correct them\n")
    typer.echo(text)
    try:
        remarks = [str(finding) for finding in read_log(logs[0], target).findings]
    except ConfigError as error:
        remarks = [str(error)]
    if remarks:
        typer.echo("Read with this draft:")
        typer.echo("\n".join(f"  {remark}" for remark in remarks))
    command = shlex.join(["diffdrive-mpc", "identify", str(logs[0]), "--mapping", str(target)])
    typer.echo(f"Next: correct {target}, then {command}")
