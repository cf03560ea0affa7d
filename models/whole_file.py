"""Files that appear whole or not at all, and folders that stay only when something was put into them."""

from __future__ import annotations

import errno
import os
import shutil
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.input_file import is_read

# A folder that one process has for itself; the system frees it however that process ends.


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


UNFINISHED = ".unfinished-"
"""Beginning of the names of scratch folders; one stays behind where its process was killed."""
_JUST_MADE = 60.0
"""A folder that is younger [s] may be about to be locked."""


@contextmanager
def whole_file(path: str | Path, *, rewrites: bool = False) -> Iterator[Path]:
    """Give a place to write a file to; on success it becomes `path`, on failure everything stays as it was.

    A link is followed, and the file that it leads to is replaced; the permissions of a replaced file stay.

    Parameters
    ----------
    path
        Path of the file.
    rewrites
        Whether it may be one that the same command reads.

    Raises
    ------
    models.checked_yaml.ConfigError
        At once, with a message that begins with `path`, if that is something else than a file, cannot be written, or
        is read by the same command; in the end, if it has been read meanwhile.
    """
    with ExitStack() as stack:
        try:
            target = Path(path).resolve()
            _check_replaceable(target, path)
            if not rewrites:
                check_not_read(target, path)
            stack.enter_context(new_folder(target.parent))
            draft = stack.enter_context(scratch_folder(target.parent)) / target.name
        except (OSError, RuntimeError) as error:  # RuntimeError: links in a circle, before Python 3.13
            raise ConfigError(f"{path}: cannot be written to ({reason(error)})") from error
        with named_errors(path, draft.parent):
            yield draft
            if not rewrites:
                check_not_read(target, path)
            if target.exists():
                shutil.copymode(target, draft)
            draft.replace(target)


@contextmanager
def named_errors(path: str | Path, scratch: Path | None = None) -> Iterator[None]:
    """Add `path` to OSErrors of writing without a file name, as for a full disk, or with one in `scratch`."""
    try:
        yield
    except OSError as error:
        names_none = error.filename is None or (scratch and Path(str(error.filename)).is_relative_to(scratch))
        if error.errno is None or not names_none:
            raise
        raise OSError(error.errno, error.strerror, str(path)) from error


@contextmanager
def new_folder(folder: Path) -> Iterator[None]:
    """Make a folder and its parents where missing; in the end those that were made and hold nothing are removed.

    Raises
    ------
    OSError
        If it cannot be made; then nothing of it stays.
    """
    made = [place for place in (folder, *folder.parents) if not place.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        yield
    finally:
        for place in made:
            with suppress(OSError):
                place.rmdir()


@contextmanager
def scratch_folder(parent: Path) -> Iterator[Path]:
    """Give a hidden folder in `parent`, on the same file system; raises OSError if `parent` cannot be written to.

    Remains of killed processes in `parent` are removed.
    """
    _clear_left_over(parent)
    with tempfile.TemporaryDirectory(prefix=UNFINISHED, dir=parent, ignore_cleanup_errors=True) as name:
        handle = lock_folder(Path(name))
        try:
            yield Path(name)
        finally:
            if handle is not None:
                os.close(handle)


def _clear_left_over(parent: Path) -> None:
    """Remove the folders that no process holds; one that has just been made may not be held yet."""
    for folder in parent.glob(f"{UNFINISHED}*"):
        with suppress(OSError):
            if folder.is_symlink() or time.time() - folder.stat().st_mtime < _JUST_MADE:
                continue
            handle = lock_folder(folder)
            if handle is not None:
                shutil.rmtree(folder, ignore_errors=True)
                os.close(handle)


def reason(error: Exception) -> str:
    """Return the system's reason for a refusal in words."""
    return getattr(error, "strerror", None) or str(error)


def check_not_read(target: Path, path: str | Path) -> None:
    """Raise ConfigError, which begins with `path`, where the file at `target` is one that the same command reads."""
    if is_read(target):
        raise ConfigError(f"{path}: this command reads that file, and would replace it; give another name")


def _check_replaceable(target: Path, path: str | Path) -> None:
    if not os.path.lexists(target):
        return
    if not target.is_file():
        raise ConfigError(f"{path}: not a regular file")
    if not os.access(target, os.W_OK):
        raise ConfigError(f"{path}: the file is read-only; give another one")
