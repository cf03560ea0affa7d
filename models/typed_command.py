"""Current command line, as entered by the user."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar

from diffdrive_mpc.models.input_file import record_inputs

OUTPUTS: dict[str, frozenset[str]] = {
    "--out": frozenset(),
    "--log": frozenset({"simulate", "excite"}),
    "--record": frozenset(),
}
"""Options that name outputs, with the commands to which this applies; empty for all commands."""
_TYPED: ContextVar[tuple[str, ...] | None] = ContextVar("typed", default=None)
_PROGRAM: ContextVar[str] = ContextVar("program", default="diffdrive-mpc")


@contextmanager
def set_command_line(arguments: Sequence[str], program: str = "diffdrive-mpc") -> Iterator[None]:
    """Set the arguments of `program` for `command_line` inside the context, and protect the input files in them."""
    before, program_before = _TYPED.set(tuple(arguments)), _PROGRAM.set(program)
    try:
        with record_inputs(named_inputs(arguments)):
            yield
    finally:
        _TYPED.reset(before)
        _PROGRAM.reset(program_before)


def named_inputs(arguments: Sequence[str]) -> list[str]:
    """List the arguments and parts of arguments that may name an input file, except values of output options."""
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
    """Format the command for a shell; "called from Python" if there is none."""
    arguments = _TYPED.get()
    return "called from Python" if arguments is None else f"{_PROGRAM.get()} {shlex.join(arguments)}"
