"""Processes that are killed, or run out of disk space, at a given change of the files of a folder."""

import errno
import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

CHANGES = ("os.mkdir", "os.rename", "os.rmdir", "os.remove", "os.truncate")
KILLED, REFUSED = -signal.SIGKILL, 3


def crash(function: Callable[[], object], folder: Path, change_index: int, *, full: bool) -> int:
    """Run `function` in a process that is killed, or has a full disk, from change `change_index` of `folder` on.

    Return 0 if `function` finished, KILLED if it was killed, REFUSED if it reported that no space is left. On a full
    disk, files can be removed and renamed.
    """
    child = os.fork()
    if child == 0:
        code = 1
        try:
            sys.addaudithook(_hook(str(folder), change_index, full))
            code = _exit_code(function)
        finally:
            os._exit(code)
    _, status = os.waitpid(child, 0)
    return os.waitstatus_to_exitcode(status)


def _exit_code(function: Callable[[], object]) -> int:
    try:
        function()
    except (OSError, ValueError) as error:
        return REFUSED if "No space left" in str(error) else 1
    return 0


def _hook(folder: str, change_index: int, full: bool) -> Callable[[str, Any], None]:
    changes = 0

    def audit(event: str, arguments: Any) -> None:
        nonlocal changes
        writes = (
            event == "open" and isinstance(arguments[2], int) and arguments[2] & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)
        )
        if not (writes or event in CHANGES) or folder not in str(arguments[0]):
            return
        changes += 1
        if changes < change_index:
            return
        if not full:
            os.kill(os.getpid(), signal.SIGKILL)
        if writes or event == "os.mkdir":
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    return audit
