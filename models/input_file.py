"""Files that a user names: read only from regular files, with a size limit."""

from __future__ import annotations

import errno
import os
import stat
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from io import BufferedReader
from pathlib import Path

# Input files of a command, none of which may be an output.


_Identity = tuple[int, int]
"""Device and number on it: the same under every name, by links of both kinds and in either case of letters."""
_READ: ContextVar[dict[_Identity, Path] | None] = ContextVar("files that are read, and where they lay", default=None)


@contextmanager
def reading(named: Iterable[str | Path] = ()) -> Iterator[None]:
    """Record the files that are read inside the context, and the existing ones of `named` from its start."""
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
    """Take note that a file is read, opened at `path`; outside of `reading` none are recorded."""
    files = _READ.get()
    if files is not None:
        files[_identity(file)] = Path(path).absolute()


def is_read(path: Path) -> bool:
    """Return True if a recorded file is at `path`."""
    files = _READ.get()
    if not files:
        return False
    try:
        identity = _identity(path.stat())
        # The number of a file that is gone may be another one's by now.
        return identity in files and _identity(files[identity].stat()) == identity
    except OSError:
        return False


def _identity(file: os.stat_result) -> _Identity:
    return file.st_dev, file.st_ino


MEGABYTE = 1_000_000
_LFS_POINTER = b"version https://git-lfs"
"""First bytes of the text that Git LFS leaves in place of a file that was not fetched."""


def open_input(path: Path) -> BufferedReader:
    """Open a regular file for reading; a pipe or a device, which may never end or never begin, is refused.

    Raises
    ------
    OSError
        If it is no regular file, cannot be opened, or was not fetched by Git LFS.
    """
    # Open without waiting for a writer of a pipe, and check the opened file itself.
    handle = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_CLOEXEC", 0))
    try:
        state = os.fstat(handle)
        mode = state.st_mode
        if stat.S_ISDIR(mode):
            raise OSError(errno.EISDIR, os.strerror(errno.EISDIR))
        if not stat.S_ISREG(mode):
            raise OSError(errno.EINVAL, "it is a pipe or a device; give a file on a disk")
        remember(state, path)
    except BaseException:
        os.close(handle)
        raise
    file = os.fdopen(handle, "rb")
    if file.peek(len(_LFS_POINTER)).startswith(_LFS_POINTER):
        file.close()
        raise OSError(errno.EINVAL, "it is a pointer of Git LFS, not the file; `git lfs pull` fetches that")
    return file


def read_input(path: Path, most: int) -> bytes:
    """Read a regular file of at most `most` bytes.

    Raises
    ------
    OSError
        As for `open_input`, or if the file is larger.
    """
    with open_input(path) as file:
        # Allocate at most the size of the file; special files may report none, and then less is read.
        content = file.read(min(most, os.fstat(file.fileno()).st_size) + 1)
    if len(content) > most:
        raise OSError(errno.EFBIG, f"it is larger than {most / MEGABYTE:g} MB, the most that is read")
    return content
