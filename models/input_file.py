"""Files that a user names: read only where they are files on a disk, and no larger than what is read should be."""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path
from typing import BinaryIO

from diffdrive_mpc.models.read_files import remember

MEGABYTE = 1_000_000


def open_input(path: Path) -> BinaryIO:
    """Open a regular file for reading; a pipe or a device, which may never end or never begin, is refused.

    Raises
    ------
    OSError
        If it is no regular file or cannot be opened.
    """
    # Without waiting for a writer at the other end of a pipe; what is opened is what is looked at.
    handle = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_CLOEXEC", 0))
    try:
        state = os.fstat(handle)
        mode = state.st_mode
        if stat.S_ISDIR(mode):
            raise OSError(errno.EISDIR, os.strerror(errno.EISDIR))
        if not stat.S_ISREG(mode):
            raise OSError(errno.EINVAL, "it is a pipe or a device; give a file on a disk")
        remember(state, path)
        return os.fdopen(handle, "rb")
    except BaseException:
        os.close(handle)
        raise


def read_input(path: Path, most: int) -> bytes:
    """All of a regular file of at most `most` bytes.

    Raises
    ------
    OSError
        As for `open_input`, or if the file is larger.
    """
    with open_input(path) as file:
        content = file.read(most + 1)
    if len(content) > most:
        raise OSError(errno.EFBIG, f"it is larger than {most / MEGABYTE:g} MB, the most that is read")
    return content
