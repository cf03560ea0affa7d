"""Files that appear whole or not at all, and folders that stay only when something was put into them."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from diffdrive_mpc.models.checked_yaml import ConfigError


@contextmanager
def whole_file(path: str | Path) -> Iterator[Path]:
    """Give a place to write a file to; on success it becomes `path`, on failure everything stays as it was.

    A link is followed, and the file that it leads to is replaced; the permissions of a replaced file are kept.

    Raises
    ------
    models.checked_yaml.ConfigError
        At once, with a message that begins with `path`, if that is something else than a file or cannot be written.
    """
    with ExitStack() as stack:
        try:
            target = Path(path).resolve()
            _check_replaceable(target, path)
            stack.enter_context(new_folder(target.parent))
            draft = stack.enter_context(scratch_folder(target.parent)) / target.name
        except (OSError, RuntimeError) as error:  # RuntimeError: links in a circle, before Python 3.13
            raise ConfigError(f"{path}: cannot be written to ({reason(error)})") from error
        yield draft
        if target.exists():
            shutil.copymode(target, draft)
        draft.replace(target)


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
    """Give a hidden folder in `parent`, on the same file system; raises OSError if `parent` cannot be written to."""
    with tempfile.TemporaryDirectory(prefix=".unfinished-", dir=parent, ignore_cleanup_errors=True) as name:
        yield Path(name)


def reason(error: Exception) -> str:
    """Why the system refused, in words."""
    return getattr(error, "strerror", None) or str(error)


def _check_replaceable(target: Path, path: str | Path) -> None:
    if not os.path.lexists(target):
        return
    if not target.is_file():
        raise ConfigError(f"{path}: not a regular file")
    if not os.access(target, os.W_OK):
        raise ConfigError(f"{path}: the file is read-only; give another one")
