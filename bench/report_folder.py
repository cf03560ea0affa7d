"""Replacement of the results in a folder, which contains either all old or all new results at any time."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

from diffdrive_mpc.models.checked_yaml import ConfigError, parse_json
from diffdrive_mpc.models.input_file import MEGABYTE, is_read, read_input
from diffdrive_mpc.models.whole_file import (
    check_not_read,
    lock_folder,
    named_errors,
    new_folder,
    reason,
    scratch_folder,
)

# Record of the commands that wrote the files of a results folder, and lock for writing.


REPORT = "report.html"
"""Name of the page in a results folder."""
CONTENTS = ".contents.json"
"""Name of the hidden file that records which command wrote each file of the folder."""
_MAX_CONTENTS_BYTES = 16 * MEGABYTE


Entries = dict[str, dict[str, Any]]
"""Entry of each file by its path in the folder: command that wrote the file, and hash of its content."""


def _contents(folder: Path) -> Entries:
    """Return the entries of the existing files of a folder; empty if the record cannot be read."""
    try:
        record: Any = parse_json(read_input(folder / CONTENTS, _MAX_CONTENTS_BYTES))
        entries = {str(name): _entry(str(entry["by"]), str(entry["sha256"])) for name, entry in record.items()}
    except (OSError, ValueError, TypeError, KeyError, AttributeError):
        return {}
    place = folder.resolve()
    return {
        name: entry for name, entry in entries.items() if (path := place / name).is_file() and path.resolve() == path
    }


def page_in(folder: Path, owner: str) -> Path:
    """Return the page that the command `owner` wrote to `folder`, see `staged`."""
    renamed = f"{owner}.html"
    return folder / (renamed if renamed in _contents(folder) else REPORT)


def _entry(owner: str, sha256: str) -> dict[str, Any]:
    return {"by": owner, "sha256": sha256}


def _entry_of(path: Path, owner: str) -> dict[str, Any]:
    # The time of the last change would not do: a copied folder has new times.
    return _entry(owner, hashlib.sha256(path.read_bytes()).hexdigest())


def _other_owner(entries: Entries, name: str, owner: str) -> str:
    """Return the command that wrote a file; empty if the command is `owner` or unknown."""
    recorded = str(entries.get(name, {}).get("by", owner))
    return "" if recorded == owner else recorded


def _outdated_files(entries: Entries, folder: Path, owner: str, new: set[str]) -> list[str]:
    """Return former results of the command `owner` that are not in `new`, except changed files and inputs."""
    return sorted(
        name
        for name, entry in entries.items()
        if entry == _entry_of(folder / name, owner) and name not in new and not is_read((folder / name).resolve())
    )


@contextmanager
def exclusive_access(folder: Path, name: object, *, wait: bool = False) -> Iterator[None]:
    """Lock a folder against other commands within the context.

    If this process is killed, the operating system releases the lock.

    Parameters
    ----------
    folder
        Existing folder.
    name
        Name of the folder in the message of the error.
    wait
        True to wait until another command releases its lock; for short locks of processes that share a folder.

    Raises
    ------
    models.checked_yaml.ConfigError
        If another command is writing into the folder.
    """
    try:
        handle = lock_folder(folder, wait=wait)
    except BlockingIOError as error:
        raise ConfigError(
            f"--out {name}: another command is writing to this folder; wait until it ends, or choose another folder"
        ) from error
    try:
        yield
    finally:
        if handle is not None:
            os.close(handle)


@contextmanager
def staged(
    target: Path, files: Sequence[str] = (), folders: Sequence[str] = (), *, owner: str = "", shared: bool = False
) -> Iterator[Path]:
    """Yield a temporary folder for the results, whose files are moved to `target` if the context succeeds.

    If the context or a move fails, `target` is unchanged. Former results of the same command are removed from `target`;
    other files in `target` are not changed. New folders that remain empty are removed.

    Parameters
    ----------
    target
        Folder of the results, which is created if missing.
    files
        Names of files that will be written; they are moved in this order, after all other files.
    folders
        Names of folders that will be written.
    owner
        Command that writes the results and whose former results are replaced. If `report.html` belongs to another
        command, the new page is named `OWNER.html`. If `owner` is empty, owners are not checked.
    shared
        True if several processes may work in `target` at the same time; otherwise, a second process raises ConfigError.

    Raises
    ------
    models.checked_yaml.ConfigError
        On entry, if `target` is a file or cannot be written to, if another process writes to `target`, or if one of
        `files` is a folder in `target`, belongs to another command, was added or changed by hand, or is an input of
        this command, or if one of `folders` is a file in `target`. On exit, if a file of the results has the name of a
        folder in `target`, or a folder that of a file; nothing is replaced in this case.
    """
    with ExitStack() as stack:
        try:
            place = target.resolve()
            stack.enter_context(new_folder(place))
            if owner and not shared:
                stack.enter_context(exclusive_access(place, target))
            scratch = stack.enter_context(scratch_folder(place))
        except (OSError, RuntimeError) as error:
            raise ConfigError(f"--out {target}: cannot be written to ({reason(error)}); choose a folder") from error
        for name in (*files, *folders):
            _check_kind(place, Path(name), target, folder=name in folders)
        _check_owners(place, target, files, owner)
        results, old = scratch / "new", scratch / "old"
        stack.enter_context(named_errors(f"--out {target}", scratch))
        results.mkdir()
        yield results
        if owner and shared:
            stack.enter_context(exclusive_access(place, target, wait=True))
        old_entries = _contents(place)
        if owner and (results / REPORT).exists() and _other_owner(old_entries, REPORT, owner):
            (results / REPORT).rename(results / f"{owner}.html")
        for path in sorted(results.rglob("*")):
            _check_kind(place, path.relative_to(results), target, folder=path.is_dir())
            if owner and path.is_file():
                within = path.relative_to(results)
                check_not_read(place / within, f"--out {target / within}")
        new = {str(path.relative_to(results)) for path in results.rglob("*") if path.is_file()}
        outdated = _outdated_files(old_entries, place, owner, {*new, *files}) if owner else []
        if owner:
            entries = {name: entry for name, entry in old_entries.items() if entry["by"] != owner and name not in new}
            entries |= {name: _entry_of(results / name, owner) for name in new}
            text = json.dumps(dict(sorted(entries.items())), indent=0) + "\n"
            (results / CONTENTS).write_text(text, encoding="utf-8")
        _move_results(results, place, old, files, outdated)


def _check_owners(place: Path, target: Path, files: Sequence[str], owner: str) -> None:
    """Raise ConfigError if `files` would replace a file of the user or of another command, whose page may remain."""
    recorded = _contents(place)
    for name in files if owner else ():
        former = _other_owner(recorded, name, owner)
        if former and name != REPORT:
            raise ConfigError(f"--out {target}: '{name}' is a result of `{former}`; choose another folder")
        check_not_read(place / name, f"--out {target / name}")
        if not former and (place / name).exists() and recorded.get(name) != _entry_of(place / name, owner):
            raise ConfigError(
                f"--out {target}: '{name}' was added or changed by hand; move it or choose another folder"
            )


def _check_kind(place: Path, name: Path, target: Path, *, folder: bool) -> None:
    """Raise ConfigError if `name` in `place` is a link or not of the expected kind, a folder or a file."""
    path = place / name
    if not os.path.lexists(path):
        return
    if path.is_symlink() or not (path.is_dir() if folder else path.is_file()):
        kind = "folder" if folder else "file"
        raise ConfigError(f"--out {target}: '{name}' exists and is not a {kind}; move or remove it")


def _move_results(results: Path, place: Path, old: Path, last: Sequence[str], outdated: Sequence[str]) -> None:
    """Move outdated files from `place` to `old` and new files to `place`; undo all moves if one of them fails.

    The files in `last` are moved after all other files, so that a page never refers to missing files.
    """
    names = [path.relative_to(results) for path in results.rglob("*") if path.is_file()]
    names.sort(key=lambda name: (last.index(str(name)) if str(name) in last else -1, name))
    moved: list[Path] = []
    with ExitStack() as created:
        try:
            for name in map(Path, outdated):
                (old / name).parent.mkdir(parents=True, exist_ok=True)
                (place / name).replace(old / name)
                moved.append(name)
            for name in names:
                created.enter_context(new_folder((place / name).parent))
                if (place / name).exists():
                    (old / name).parent.mkdir(parents=True, exist_ok=True)
                    shutil.copy2(place / name, old / name)
                (results / name).replace(place / name)
                moved.append(name)
        except BaseException:
            for name in reversed(moved):
                if (old / name).exists():
                    (old / name).replace(place / name)
                else:
                    (place / name).unlink()
            raise
    for folder in {(place / name).parent for name in outdated} - {place}:
        with suppress(OSError):  # not empty
            folder.rmdir()
