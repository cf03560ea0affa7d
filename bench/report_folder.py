"""Write a folder of results so that it holds the old ones or the new ones, never a mixture that is half written."""

from __future__ import annotations

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

# Record of the writing commands of a results folder, and lock for writing.


REPORT = "report.html"
"""Name of the page in a folder of results."""
CONTENTS = ".contents.json"
"""In the folder; hidden, since it is for internal use."""
_LARGEST = 16 * MEGABYTE


Entries = dict[str, dict[str, Any]]
"""Files of a folder by their path in it: the command that wrote each, size [bytes] and time of the last change [ns]."""


def _contents(folder: Path) -> Entries:
    """Return the entries of a folder; none if its list cannot be read."""
    try:
        listed: Any = parse_json(read_input(folder / CONTENTS, _LARGEST))
        entries = {
            str(name): _entry(str(entry["by"]), entry["bytes"], entry["changed_ns"]) for name, entry in listed.items()
        }
    except (OSError, ValueError, TypeError, KeyError, AttributeError):
        return {}
    whole = folder.resolve()
    return {
        name: entry for name, entry in entries.items() if (path := whole / name).is_file() and path.resolve() == path
    }


def _entry(owner: str, size: int, changed: int) -> dict[str, Any]:
    return {"by": owner, "bytes": int(size), "changed_ns": int(changed)}


def _entry_of(path: Path, owner: str) -> dict[str, Any]:
    status = path.stat()
    return _entry(owner, status.st_size, status.st_mtime_ns)


def _other_owner(entries: Entries, name: str, owner: str) -> str:
    """Return the command that wrote a file; empty if it is `owner` or unknown."""
    known = str(entries.get(name, {}).get("by", owner))
    return "" if known == owner else known


def _stale(entries: Entries, folder: Path, owner: str, new: set[str]) -> list[str]:
    """Return files that the command wrote before and not now; a file that was changed since, or is read, stays."""
    return sorted(
        name
        for name, entry in entries.items()
        if entry == _entry_of(folder / name, owner) and name not in new and not is_read((folder / name).resolve())
    )


@contextmanager
def alone_in(folder: Path, shown: object, *, wait: bool = False) -> Iterator[None]:
    """Keep other commands out of a folder meanwhile; the system lets them in again however this process ends.

    Parameters
    ----------
    folder
        The folder, which exists.
    shown
        Name of the folder in the message.
    wait
        Whether to wait for the other command to finish, as where several share a folder and each is quickly done.

    Raises
    ------
    models.checked_yaml.ConfigError
        If another command is writing there.
    """
    try:
        handle = lock_folder(folder, wait=wait)
    except BlockingIOError as error:
        raise ConfigError(
            f"--out {shown}: another command is writing there; wait for its end, or give another folder"
        ) from error
    try:
        yield
    finally:
        if handle is not None:
            os.close(handle)


@contextmanager
def staged(
    target: Path,
    files: Sequence[str] = (),
    folders: Sequence[str] = (),
    *,
    owner: str = "",
    shared: bool = False,
) -> Iterator[Path]:
    """Yield a temporary folder to write into; on success its files go to `target`, on failure none of them do.

    Other files of `target` stay, also in folders that get new files, except for former results of the same command
    without a fixed name. Folders made for nothing are removed.

    Parameters
    ----------
    target
        Folder for the results; made where missing.
    files
        Names of files that will be written; they are put in place last, in this order.
    folders
        Names of folders that will be written.
    owner
        The command whose results these are. What it wrote there before is replaced, and its page goes by its own name
        where `report.html` is that of another command; where it is empty, neither is checked.
    shared
        Whether several processes may work in `target` at the same time; else a second one is refused.

    Raises
    ------
    models.checked_yaml.ConfigError
        At once, if `target` is a file or cannot be written to, if another process writes there, if one of `files` is a
        folder there or the reverse, belongs to another command, or is read by this one. In the end, if another of the
        results meets something that is not of its kind; then nothing is replaced.
    """
    with ExitStack() as stack:
        try:
            place = target.resolve()
            stack.enter_context(new_folder(place))
            if owner and not shared:
                stack.enter_context(alone_in(place, target))
            scratch = stack.enter_context(scratch_folder(place))
        except (OSError, RuntimeError) as error:
            raise ConfigError(f"--out {target}: cannot be written to ({reason(error)}); give a folder") from error
        for name in (*files, *folders):
            _check_kind(place, Path(name), target, folder=name in folders)
        _check_owners(place, target, files, owner)
        results, old = scratch / "new", scratch / "old"
        stack.enter_context(named_errors(f"--out {target}", scratch))
        results.mkdir()
        yield results
        if owner and shared:
            stack.enter_context(alone_in(place, target, wait=True))
        before = _contents(place)
        if owner and (results / REPORT).exists() and _other_owner(before, REPORT, owner):
            (results / REPORT).rename(results / f"{owner}.html")
        for path in sorted(results.rglob("*")):
            _check_kind(place, path.relative_to(results), target, folder=path.is_dir())
            if owner and path.is_file():
                within = path.relative_to(results)
                check_not_read(place / within, f"--out {target / within}")
        new = {str(path.relative_to(results)) for path in results.rglob("*") if path.is_file()}
        stale = _stale(before, place, owner, {*new, *files}) if owner else []
        if owner:
            entries = {name: entry for name, entry in before.items() if entry["by"] != owner and name not in new}
            entries |= {name: _entry_of(results / name, owner) for name in new}
            text = json.dumps(dict(sorted(entries.items())), indent=0) + "\n"
            (results / CONTENTS).write_text(text, encoding="utf-8")
        _put_in_place(results, place, old, files, stale)


def _check_owners(place: Path, target: Path, files: Sequence[str], owner: str) -> None:
    """Refuse to replace a file of another command; of its page only the name is another."""
    known = _contents(place)
    for name in files if owner else ():
        former = _other_owner(known, name, owner)
        if former and name != REPORT:
            raise ConfigError(f"--out {target}: '{name}' there is a result of `{former}`; give another folder")
        check_not_read(place / name, f"--out {target / name}")


def _check_kind(place: Path, name: Path, target: Path, *, folder: bool) -> None:
    """Refuse a file where a folder is needed and the reverse, and links: their targets must not be replaced."""
    path = place / name
    if not os.path.lexists(path):
        return
    if path.is_symlink() or not (path.is_dir() if folder else path.is_file()):
        kind = "folder" if folder else "file"
        raise ConfigError(f"--out {target}: '{name}' there is in the way of a {kind} of the results; move it away")


def _put_in_place(results: Path, place: Path, old: Path, last: Sequence[str], stale: Sequence[str]) -> None:
    """Move every file to its place, and stale ones away; undo all moves if one fails."""
    names = [path.relative_to(results) for path in results.rglob("*") if path.is_file()]
    names.sort(key=lambda name: (last.index(str(name)) if str(name) in last else -1, name))
    done: list[Path] = []
    with ExitStack() as made:
        try:
            for name in map(Path, stale):
                (old / name).parent.mkdir(parents=True, exist_ok=True)
                (place / name).replace(old / name)
                done.append(name)
            for name in names:
                made.enter_context(new_folder((place / name).parent))
                if (place / name).exists():
                    (old / name).parent.mkdir(parents=True, exist_ok=True)
                    shutil.copy2(place / name, old / name)
                (results / name).replace(place / name)
                done.append(name)
        except BaseException:
            for name in reversed(done):
                if (old / name).exists():
                    (old / name).replace(place / name)
                else:
                    (place / name).unlink()
            raise
    for folder in {(place / name).parent for name in stale} - {place}:
        with suppress(OSError):  # not empty
            folder.rmdir()
