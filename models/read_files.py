"""Which files a command reads: none of them may be what it writes."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from pathlib import Path

_Identity = tuple[int, int]
"""Device and number on it: the same under every name, by links of both kinds and in either case of letters."""
_READ: ContextVar[dict[_Identity, Path] | None] = ContextVar("files that are read, and where they lay", default=None)


@contextmanager
def reading(named: Iterable[str | Path] = ()) -> Iterator[None]:
    """Within, files that are read are remembered, those of `named` that are there from the start."""
    token = _READ.set({})
    try:
        for path in named:
            with suppress(OSError, ValueError):  # no such file, or no name of one
                if Path(path).is_file():
                    remember(Path(path).stat(), path)
        yield
    finally:
        _READ.reset(token)


def remember(file: os.stat_result, path: str | Path) -> None:
    """Take note that a file is read, opened at `path`; outside of `reading` nobody does."""
    found = _READ.get()
    if found is not None:
        found[_identity(file)] = Path(path).absolute()


def is_read(path: Path) -> bool:
    """Whether there is a file at `path` that is read."""
    found = _READ.get()
    if not found:
        return False
    try:
        identity = _identity(path.stat())
        # The number of a file that is gone may be another one's by now.
        return identity in found and _identity(found[identity].stat()) == identity
    except OSError:
        return False


def _identity(file: os.stat_result) -> _Identity:
    return file.st_dev, file.st_ino
