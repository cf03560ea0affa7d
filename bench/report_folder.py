"""Write a folder of results so that it holds the old ones or the new ones, never a mixture that is half written."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from diffdrive_mpc.models.checked_yaml import ConfigError, parse_json
from diffdrive_mpc.models.input_file import MEGABYTE, is_read, read_input
from diffdrive_mpc.models.whole_file import check_not_read, lock_folder, new_folder, reason, scratch_folder

# Which command wrote what into a folder of results, and who is writing there now.


REPORT = "report.html"
"""Name of the page in a folder of results."""
CONTENTS = ".contents.json"
"""In the folder; hidden, as nobody needs to read it."""
_LARGEST = 50 * MEGABYTE


@dataclass(frozen=True)
class Contents:
    """Files of a folder, by their path in it.

    Attributes
    ----------
    owners
        The command that wrote each.
    states
        Size [bytes] and time of the last change [ns] of each, as it was left.
    """

    owners: Mapping[str, str] = field(default_factory=dict)
    states: Mapping[str, tuple[int, int]] = field(default_factory=dict)

    @classmethod
    def of(cls, folder: Path) -> Contents:
        """Of what is in a folder; of nothing where it does not say, or says what cannot be read."""
        try:
            stated: Any = parse_json(read_input(folder / CONTENTS, _LARGEST))
            owners = {str(name): str(one["by"]) for name, one in stated.items()}
            states = {str(name): (int(one["bytes"]), int(one["changed_ns"])) for name, one in stated.items()}
        except (OSError, ValueError, TypeError, KeyError, AttributeError):
            return cls()
        whole = folder.resolve()
        there = {name for name in owners if (whole / name).is_file() and (whole / name).resolve() == whole / name}
        return cls({name: owners[name] for name in there}, {name: states[name] for name in there})

    def others(self, name: str, owner: str) -> str:
        """Which other command a file is of; empty for none."""
        known = self.owners.get(name, owner)
        return "" if known == owner else known

    def page(self, owner: str) -> str:
        """Name of the page of a command: its own where the usual one is that of another."""
        return f"{owner}.html" if self.others(REPORT, owner) else REPORT

    def stale(self, folder: Path, owner: str, new: set[str]) -> list[str]:
        """What the command wrote there before, and is not in `new`; what was changed since, or is read, stays."""
        left = [
            name
            for name, known in self.owners.items()
            if known == owner and name not in new and not is_read((folder / name).resolve())
        ]
        return sorted(name for name in left if _state(folder / name) == self.states[name])

    def text(self, folder: Path, owner: str, new: set[str]) -> str:
        """What the folder is to say once the command has written `new`."""
        kept = {name: by for name, by in self.owners.items() if by != owner and name not in new}
        entries = {name: (by, self.states[name]) for name, by in kept.items()}
        entries |= {name: (owner, _state(folder / name)) for name in new}
        rows = {name: {"by": by, "bytes": size, "changed_ns": time} for name, (by, (size, time)) in entries.items()}
        return json.dumps(dict(sorted(rows.items())), indent=0) + "\n"


def _state(path: Path) -> tuple[int, int]:
    status = path.stat()
    return status.st_size, status.st_mtime_ns


@contextmanager
def alone_in(folder: Path, shown: object, *, wait: bool = False) -> Iterator[None]:
    """Keep other commands out of a folder meanwhile; the system lets them in again however this process ends.

    Parameters
    ----------
    folder
        The folder, which exists.
    shown
        Its name for the message.
    wait
        Whether to wait until the other one is done, as where several share a folder and each is quickly done.

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
    """Give a temporary folder to write into; on success its files go to `target`, on failure nothing does.

    Other files of `target` stay, also those in folders that get new files, but for those that the same command left
    there before and that have no fixed name. Folders made for nothing are removed.

    Parameters
    ----------
    target
        Where the results belong; made where missing.
    files
        Names of files that will be written; they are put in place last, in this order.
    folders
        Names of folders that will be written.
    owner
        The command whose results these are. What it wrote there before is replaced, and its page goes by its own
        name where `report.html` is that of another command; where it is empty, neither is looked at.
    shared
        Whether several processes work in `target` at a time; else a second one is refused.

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
        results.mkdir()
        yield results
        if owner and shared:
            stack.enter_context(alone_in(place, target, wait=True))
        before = Contents.of(place)
        if owner and (results / REPORT).exists():
            (results / REPORT).rename(results / before.page(owner))
        for path in sorted(results.rglob("*")):
            _check_kind(place, path.relative_to(results), target, folder=path.is_dir())
            if owner and path.is_file():
                within = path.relative_to(results)
                check_not_read(place / within, f"--out {target / within}")
        new = {str(path.relative_to(results)) for path in results.rglob("*") if path.is_file()}
        stale = before.stale(place, owner, {*new, *files}) if owner else []
        if owner:
            (results / CONTENTS).write_text(before.text(results, owner, new), encoding="utf-8")
        _put_in_place(results, place, old, files, stale)


def _check_owners(place: Path, target: Path, files: Sequence[str], owner: str) -> None:
    """Refuse to replace a file of another command; of its page only the name is another."""
    known = Contents.of(place)
    for name in files:
        other = known.others(name, owner)
        if owner and other and name != REPORT:
            raise ConfigError(f"--out {target}: '{name}' there is a result of `{other}`; give another folder")
        if owner:
            check_not_read(place / name, f"--out {target / name}")


def _check_kind(place: Path, name: Path, target: Path, *, folder: bool) -> None:
    """Refuse a file where a folder is needed and the reverse, and links: what they lead to is not ours to replace."""
    path = place / name
    if not os.path.lexists(path):
        return
    if path.is_symlink() or not (path.is_dir() if folder else path.is_file()):
        kind = "folder" if folder else "file"
        raise ConfigError(f"--out {target}: '{name}' there is in the way of a {kind} of the results; move it away")


def _put_in_place(results: Path, place: Path, old: Path, last: Sequence[str], stale: Sequence[str]) -> None:
    """Move every file to its place, and stale ones away; when one cannot be moved, undo what was done."""
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
