"""A folder that one process has for itself; the system frees it however that process ends."""

from __future__ import annotations

import errno
import os
from pathlib import Path

_TAKEN = (errno.EWOULDBLOCK, errno.EAGAIN, errno.EACCES)


def lock_folder(folder: Path, *, wait: bool = False) -> int | None:
    """Lock a folder that exists.

    Parameters
    ----------
    folder
        The folder. Nothing is written into it.
    wait
        Whether to wait until another process frees it.

    Returns
    -------
    int or None
        A handle that holds the lock until it is closed; None where system or file system have no such locks.

    Raises
    ------
    BlockingIOError
        If another process has it.
    OSError
        If the folder cannot be opened.
    """
    try:
        import fcntl  # noqa: PLC0415 - not on every system
    except ImportError:
        return None
    handle = os.open(folder, os.O_RDONLY | os.O_CLOEXEC)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
    except OSError as error:
        os.close(handle)
        if error.errno in _TAKEN:
            raise BlockingIOError(errno.EWOULDBLOCK, "another process has it") from error
        return None
    except BaseException:
        os.close(handle)
        raise
    return handle
