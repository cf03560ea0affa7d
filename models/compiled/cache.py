"""Cache of compiled libraries, keyed by their sources; only intact libraries in private folders are loaded.

The file name of a library contains the digests of its sources and of its content, so that one atomic rename installs
both. The content digest is checked before each load, because loading a library runs code.
"""

from __future__ import annotations

import hashlib
import logging
import os
import stat
import tempfile
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import TypeVar

from diffdrive_mpc.models.compiled.compiler import NotCompiledError

CACHE_VARIABLE = "DIFFDRIVE_MPC_CACHE"
"""Environment variable that names the folder of compiled libraries."""

_Loaded = TypeVar("_Loaded")
_log = logging.getLogger(__name__)


def load_cached(stem: str, origin: str, build: Callable[[Path], Path], load: Callable[[Path], _Loaded]) -> _Loaded:
    """Load a library from the cache; build it first if the cache has no intact copy.

    Parameters
    ----------
    stem
        First part of the file name.
    origin
        Digest of all inputs of the build.
    build
        Function that builds the library in an empty folder and returns its path.
    load
        Function that loads the library; raises OSError on failure.

    Raises
    ------
    NotCompiledError
        If the library cannot be built, or no folder is writable.
    """
    faults = []
    for folder in _folders():
        try:
            return _load_in(folder, f"{stem}-{origin[:32]}", build, load)
        except OSError as error:
            faults.append(f"{folder}: {error.strerror or error}")
    raise NotCompiledError(f"{'; '.join(faults)}; set {CACHE_VARIABLE} to a folder of your own")


def content_digest(path: Path) -> str:
    """Compute the SHA-256 of a file, in hexadecimal digits.

    Raises
    ------
    OSError
        If it cannot be read.
    """
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _load_in(folder: Path, stem: str, build: Callable[[Path], Path], load: Callable[[Path], _Loaded]) -> _Loaded:
    for path in sorted(folder.glob(f"{stem}-*.so")):
        if _is_intact(path):
            return load(path)
        _log.warning("%s is damaged; it is compiled again", path)
        with suppress(OSError):
            path.unlink()
    with tempfile.TemporaryDirectory(dir=folder, prefix="build-") as build_folder:
        built = build(Path(build_folder))
        path = folder / f"{stem}-{content_digest(built)}.so"
        # Flush the content before the name, so that a name with a digest never refers to incomplete content.
        _flush_to_disk(built)
        # The rename is atomic, because another process may install the same library at the same time.
        built.replace(path)
        _flush_to_disk(folder)
    return load(path)


def _is_intact(path: Path) -> bool:
    """Return True if the content matches the digest in the name."""
    try:
        return content_digest(path) == path.stem.rpartition("-")[2]
    except OSError:
        return False


def _flush_to_disk(path: Path) -> None:
    """Flush a file or folder to disk, so that a power cut does not leave a name without its content."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _folders() -> Iterator[Path]:
    """Yield folders to which no other user can write: first the user's cache, then private temporary folders."""
    for folder in (user_folder, _shared_private_folder):
        try:
            path = folder()
            path.mkdir(mode=0o700, parents=True, exist_ok=True)
            reason = _access_fault(path)
        except (OSError, RuntimeError) as error:
            reason = getattr(error, "strerror", None) or str(error)
        if reason is None:
            yield path
        elif folder is user_folder:
            _log.warning("no compiled library is stored in the cache folder (%s); see %s", reason, CACHE_VARIABLE)
    # A folder of this process is always available, but the library is then compiled again in each process.
    yield _process_folder()


def user_folder() -> Path:
    """Return the configured folder, or else the user's cache; raise RuntimeError if there is no home folder."""
    configured = os.environ.get(CACHE_VARIABLE)
    if configured:
        return Path(configured).expanduser().resolve()
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache").resolve() / "diffdrive-mpc"


def _shared_private_folder() -> Path:
    """Return a folder of this user in the system's folder for temporary files."""
    return Path(tempfile.gettempdir()).resolve() / f"diffdrive-mpc-{os.geteuid()}"


@cache
def _process_folder() -> Path:
    """Return a folder that is removed at the end of this process."""
    folder = tempfile.TemporaryDirectory(prefix="diffdrive-mpc-")
    _process_folders.append(folder)
    return Path(folder.name)


_process_folders: list[tempfile.TemporaryDirectory[str]] = []


def _access_fault(folder: Path) -> str | None:
    """Describe why another user could have written to `folder`, which is not a link; None if this is impossible."""
    status = folder.lstat()
    if not stat.S_ISDIR(status.st_mode):
        return f"{folder} is not a folder"
    if status.st_uid not in (os.geteuid(), 0):
        return f"{folder} belongs to another user"
    if status.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        return f"other users can write to {folder}"
    return None
