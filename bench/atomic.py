"""Write a folder of results so that it holds the old ones or the new ones, never a mixture that is half written."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from diffdrive_mpc.bench.contents import CONTENTS, REPORT, Contents, alone_in
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.whole_file import check_not_read, new_folder, reason, scratch_folder


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
