"""The command that is being carried out, as it was typed."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar

_TYPED: ContextVar[tuple[str, ...] | None] = ContextVar("typed", default=None)


@contextmanager
def typed(arguments: Sequence[str]) -> Iterator[None]:
    """Within, `command_line` tells these arguments."""
    before = _TYPED.set(tuple(arguments))
    try:
        yield
    finally:
        _TYPED.reset(before)


def command_line() -> str:
    """The command, to be pasted into a shell; what called instead where there is none."""
    arguments = _TYPED.get()
    return "called from Python" if arguments is None else shlex.join(["diffdrive-mpc", *arguments])
