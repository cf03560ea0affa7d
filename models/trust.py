"""Protection against files that logs, bags or run files name: only files in trusted folders are opened or run."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import NamedTuple

from diffdrive_mpc.models.checked_yaml import ConfigError


class UntrustedFileError(ConfigError):
    """Error for untrusted data that names a file outside trusted folders: one line with place and remedy."""


class _Trust(NamedTuple):
    source: str
    folders: tuple[Path, ...]


_TRUST: ContextVar[_Trust | None] = ContextVar("trust", default=None)


@contextmanager
def only_trusted(source: str | Path, folders: Sequence[Path] = ()) -> Iterator[None]:
    """Reject files that are neither shipped nor in one of `folders` inside this context.

    Parameters
    ----------
    source
        Source of the names, for the message.
    folders
        Folders whose files may be opened and run, including subfolders.
    """
    token = _TRUST.set(_Trust(str(source), tuple(folder.resolve() for folder in folders)))
    try:
        yield
    finally:
        _TRUST.reset(token)


@contextmanager
def also_trusted(folder: Path) -> Iterator[None]:
    """Add `folder` to the trusted folders inside the context, for files that this program writes."""
    trust = _TRUST.get()
    if trust is None:
        yield
        return
    with only_trusted(trust.source, (*trust.folders, folder)):
        yield


def check_trusted(path: str | Path) -> None:
    """Raise UntrustedFileError if the file at `path` must not be opened; links are resolved."""
    trust = _TRUST.get()
    if trust is not None and not is_trusted(path):
        raise UntrustedFileError(
            f"{trust.source} names '{path}', which is not shipped: such files are neither opened nor run; if you "
            f"trust all files in its folder, give --trust-terms {Path(path).resolve().parent}"
        )


def is_trusted(path: str | Path) -> bool:
    """Return True if the file at `path` may be opened; see `check_trusted`."""
    trust = _TRUST.get()
    if trust is None:
        return True
    place = Path(path).resolve()
    return any(place.is_relative_to(folder) for folder in trust.folders)
