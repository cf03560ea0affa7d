"""Reading of input files: only regular files, with a size limit and a record of the files that were read."""

from __future__ import annotations

import errno
import os
import stat
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from io import BufferedReader
from pathlib import Path

# Record of the input files of a command, which must not be overwritten by its outputs.


_Identity = tuple[int, int]
"""Device and inode number: independent of the file name, of links, and of case-insensitive file systems."""
_READ: ContextVar[dict[_Identity, Path] | None] = ContextVar("paths of the files that were read", default=None)


@contextmanager
def record_inputs(named: Iterable[str | Path] = ()) -> Iterator[None]:
    """Record the files that are read inside the context, and from its start also the existing files in `named`."""
    token = _READ.set({})
    try:
        for path in named:
            with suppress(OSError, ValueError):  # the file is missing or the name invalid
                if Path(path).is_file():
                    record_input(Path(path).stat(), path)
        yield
    finally:
        _READ.reset(token)


def record_input(file: os.stat_result, path: str | Path) -> None:
    """Record that the file at `path` is read; do nothing outside of `record_inputs`."""
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
        # The inode number of a deleted file may be reused for a new file.
        return identity in files and _identity(files[identity].stat()) == identity
    except OSError:
        return False


def _identity(file: os.stat_result) -> _Identity:
    return file.st_dev, file.st_ino


MEGABYTE = 1_000_000
_LFS_POINTER = b"version https://git-lfs"
"""First bytes of the text that Git LFS stores instead of a file that was not fetched."""


def open_input(path: Path) -> BufferedReader:
    """Open a regular file for reading; reject pipes and devices, which may block or never end.

    Raises
    ------
    OSError
        If the file is not regular, cannot be opened, or was not fetched by Git LFS.
    """
    # Open without waiting for a pipe's writer, and check the opened file rather than its name.
    handle = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_CLOEXEC", 0))
    try:
        state = os.fstat(handle)
        mode = state.st_mode
        if stat.S_ISDIR(mode):
            raise OSError(errno.EISDIR, os.strerror(errno.EISDIR))
        if not stat.S_ISREG(mode):
            raise OSError(errno.EINVAL, "it is a pipe or a device; give a file on a disk")
        record_input(state, path)
    except BaseException:
        os.close(handle)
        raise
    file = os.fdopen(handle, "rb")
    if file.peek(len(_LFS_POINTER)).startswith(_LFS_POINTER):
        file.close()
        raise OSError(errno.EINVAL, "it is a pointer of Git LFS, not the file; fetch it: `git lfs pull`")
    return file


def read_input(path: Path, max_bytes: int) -> bytes:
    """Read a regular file of at most `max_bytes` bytes.

    Raises
    ------
    OSError
        As for `open_input`, or if the file is larger.
    """
    with open_input(path) as file:
        # Allocate at most the size of the file; a special file may report size 0 and is then read only in part.
        content = file.read(min(max_bytes, os.fstat(file.fileno()).st_size) + 1)
    if len(content) > max_bytes:
        raise OSError(errno.EFBIG, f"it is larger than {max_bytes / MEGABYTE:g} MB, the limit")
    return content
