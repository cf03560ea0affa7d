"""A command that a plug-in adds to the command line."""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from diffdrive_mpc.models.input_file import reading


@dataclass(frozen=True)
class PluggedCommand:
    """One command.

    Attributes
    ----------
    panel
        Under which `diffdrive-mpc --help` shows it.
    name
        What is typed.
    run
        The function whose parameters are its options; it imports what it needs when it runs.
    example
        The last line of its help.
    """

    panel: str
    name: str
    run: Callable[..., None]
    example: str


# Options that commands and studies share, each declared once.


def out_folder(text: str) -> Path:
    """Read the folder of `--out`; raises typer.BadParameter when it is empty, which would be the current folder."""
    if not text.strip():
        raise typer.BadParameter("it is empty; give a folder, '.' for the current one")
    return Path(text)


def out_option(what: str, usual: str | None = None) -> Any:  # noqa: ANN401 - typer's own type
    """The option that names a folder for `what`, and the usual one where it need not be given."""
    shown: str | bool = usual or False
    return typer.Option("--out", parser=out_folder, metavar="PATH", help=f"Folder for {what}.", show_default=shown)


def file_option(what: str, name: str) -> Any:  # noqa: ANN401 - typer's own type
    """The option that takes a YAML file in place of a shipped one."""
    return typer.Option(name, help=f"{what} (YAML) in place of the shipped one.", show_default=False)


Jobs = Annotated[int | None, typer.Option("--jobs", min=1, help="Processes.", show_default="one for each core")]


# The command that is being carried out, as it was typed.


OUTPUTS: dict[str, frozenset[str]] = {
    "--out": frozenset(),
    "--log": frozenset({"simulate", "excite"}),
    "--rerun": frozenset(),
    "--record": frozenset(),
    "--to": frozenset({"log"}),
}
"""Options that name what is written, and by which commands; of all where there is none."""
_TYPED: ContextVar[tuple[str, ...] | None] = ContextVar("typed", default=None)
_PROGRAM: ContextVar[str] = ContextVar("program", default="diffdrive-mpc")


@contextmanager
def typed(arguments: Sequence[str], program: str = "diffdrive-mpc") -> Iterator[None]:
    """Within, `command_line` tells these arguments of `program`, and no file that they name to be read is written."""
    before, program_before = _TYPED.set(tuple(arguments)), _PROGRAM.set(program)
    try:
        with reading(named_inputs(arguments)):
            yield
    finally:
        _TYPED.reset(before)
        _PROGRAM.reset(program_before)


def named_inputs(arguments: Sequence[str]) -> list[str]:
    """What in a command may name a file to be read: every word, and part of one, but what follows an output option."""
    outputs = {option for option, commands in OUTPUTS.items() if not commands or commands & set(arguments[:1])}
    parts: list[str] = []
    for before, word in zip(("", *arguments), arguments, strict=False):
        option, equals, value = word.partition("=")
        if before in outputs or (equals and option in outputs):
            continue
        parts += [word, value] if equals else [word]
        parts += re.split("[,:]", value or word)
    return [part for part in parts if part]


def command_line() -> str:
    """The command, to be pasted into a shell; what called instead where there is none."""
    arguments = _TYPED.get()
    return "called from Python" if arguments is None else f"{_PROGRAM.get()} {shlex.join(arguments)}"
