"""Atomic writing of files, and temporary folders."""

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

# Exclusive lock of a folder; the operating system releases it when the process ends, even if it is killed.


_LOCKED = (errno.EWOULDBLOCK, errno.EAGAIN, errno.EACCES)


def lock_folder(folder: Path, *, wait: bool = False) -> int | None:
    """Lock an existing folder.

    Parameters
    ----------
    folder
        The folder; its content is not changed.
    wait
        True to wait until another process releases the lock.

    Returns
    -------
    int or None
        Handle that holds the lock until it is closed; None if the system or file system does not support locks.

    Raises
    ------
    BlockingIOError
        If another process holds the lock.
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
        if error.errno in _LOCKED:
            raise BlockingIOError(errno.EWOULDBLOCK, "another process holds the lock") from error
        return None
    except BaseException:
        os.close(handle)
        raise
    return handle


UNFINISHED = ".unfinished-"
"""Prefix of the names of scratch folders; a scratch folder remains if its process is killed."""
_MIN_AGE = 60.0
"""Minimum age [s] of unlocked scratch folders that are removed; younger folders may not be locked yet."""


@contextmanager
def whole_file(path: str | Path, *, rewrites: bool = False, begins: bytes = b"") -> Iterator[Path]:
    """Yield a temporary path for writing; on success the file replaces `path`, on failure `path` is unchanged.

    Links are resolved, and their target is replaced. A new file has the permissions of the file that it replaces.

    Parameters
    ----------
    path
        Path of the file.
    rewrites
        True if `path` may be an input of the same command.
    begins
        First bytes that an existing file must have unless it is empty, so that no foreign file is replaced.

    Raises
    ------
    models.checked_yaml.ConfigError
        With a message that starts with `path`: on entry if `path` is not a regular file, is not writable, was read by
        the same command, or does not begin with `begins`; on exit if it was read in the context.
    """
    with ExitStack() as stack:
        try:
            target = Path(path).resolve()
            _check_replaceable(target, path)
            if not rewrites:
                check_not_read(target, path)
            if begins and target.exists():
                _check_beginning(target, path, begins)
            stack.enter_context(new_folder(target.parent))
            # The draft is in the folder of the target, because a rename is atomic only within one file system.
            draft = stack.enter_context(scratch_folder(target.parent)) / target.name
        except (OSError, RuntimeError) as error:  # RuntimeError: links in a circle, before Python 3.13
            raise ConfigError(f"{path}: cannot be written to ({reason(error)}); choose another folder") from error
        with named_errors(path, draft.parent):
            yield draft
            if not rewrites:
                check_not_read(target, path)
            if target.exists():
                shutil.copymode(target, draft)
            draft.replace(target)


@contextmanager
def named_errors(path: str | Path, scratch: Path | None = None) -> Iterator[None]:
    """Add `path` to an OSError without a file name, such as for a full disk, or with a file name in `scratch`."""
    try:
        yield
    except OSError as error:
        is_unnamed = error.filename is None or (scratch and Path(str(error.filename)).is_relative_to(scratch))
        if error.errno is None or not is_unnamed:
            raise
        raise OSError(error.errno, error.strerror, str(path)) from error


@contextmanager
def new_folder(folder: Path) -> Iterator[None]:
    """Create a folder and its missing parents; on exit, remove those created folders that are empty.

    Raises
    ------
    OSError
        If the folder cannot be created; created parents are removed.
    """
    created = [path for path in (folder, *folder.parents) if not path.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        yield
    finally:
        for path in created:
            with suppress(OSError):
                path.rmdir()


@contextmanager
def scratch_folder(parent: Path) -> Iterator[Path]:
    """Yield a hidden temporary folder in `parent`; raise OSError if `parent` is not writable.

    Scratch folders of killed processes in `parent` are removed.
    """
    _remove_stale(parent)
    with tempfile.TemporaryDirectory(prefix=UNFINISHED, dir=parent, ignore_cleanup_errors=True) as name:
        handle = lock_folder(Path(name))
        try:
            yield Path(name)
        finally:
            if handle is not None:
                os.close(handle)


def _remove_stale(parent: Path) -> None:
    """Remove unlocked scratch folders, except new folders, which may not be locked yet."""
    for folder in parent.glob(f"{UNFINISHED}*"):
        with suppress(OSError):
            if folder.is_symlink() or time.time() - folder.stat().st_mtime < _MIN_AGE:
                continue
            handle = lock_folder(folder)
            if handle is not None:
                shutil.rmtree(folder, ignore_errors=True)
                os.close(handle)


def reason(error: Exception) -> str:
    """Return the message of an error; for an OSError, without file name and error number."""
    return getattr(error, "strerror", None) or str(error)


def check_not_read(target: Path, path: str | Path) -> None:
    """Raise ConfigError, with a message that starts with `path`, if the same command has read the file at `target`."""
    if is_read(target):
        raise ConfigError(f"{path}: this command reads this file and would replace it; give another name")


def _check_replaceable(target: Path, path: str | Path) -> None:
    if not os.path.lexists(target):
        return
    if not target.is_file():
        raise ConfigError(f"{path}: not a regular file; give the name of a file")
    if not os.access(target, os.W_OK):
        raise ConfigError(f"{path}: the file is read-only; give another one")


def _check_beginning(target: Path, path: str | Path, begins: bytes) -> None:
    with target.open("rb") as file:
        if file.read(len(begins)) not in (b"", begins):
            raise ConfigError(f"{path}: the file exists and is of another kind; give another name")
