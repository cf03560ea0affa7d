"""Write a folder of results so that it holds the old ones or the new ones, never a mixture that is half written."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.whole_file import new_folder, reason, scratch_folder


@contextmanager
def staged(target: Path, files: Sequence[str] = (), folders: Sequence[str] = ()) -> Iterator[Path]:
    """Give a temporary folder to write into; on success its files go to `target`, on failure nothing does.

    Other files of `target` stay, also those in folders that get new files. Folders made for nothing are removed.

    Parameters
    ----------
    target
        Where the results belong; made where missing.
    files
        Names of files that will be written; they are put in place last, in this order.
    folders
        Names of folders that will be written.

    Raises
    ------
    models.checked_yaml.ConfigError
        At once, if `target` is a file or cannot be written to, or if one of `files` is a folder there or the reverse.
        In the end, if another of the results meets something that is not of its kind; then nothing is replaced.
    """
    with ExitStack() as stack:
        try:
            place = target.resolve()
            stack.enter_context(new_folder(place))
            scratch = stack.enter_context(scratch_folder(place))
        except (OSError, RuntimeError) as error:
            raise ConfigError(f"--out {target}: cannot be written to ({reason(error)}); give a folder") from error
        for name in (*files, *folders):
            _check_kind(place, Path(name), target, folder=name in folders)
        results, old = scratch / "new", scratch / "old"
        results.mkdir()
        yield results
        for path in sorted(results.rglob("*")):
            _check_kind(place, path.relative_to(results), target, folder=path.is_dir())
        _put_in_place(results, place, old, files)


def _check_kind(place: Path, name: Path, target: Path, *, folder: bool) -> None:
    """Refuse a file where a folder is needed and the reverse, and links: what they lead to is not ours to replace."""
    path = place / name
    if not os.path.lexists(path):
        return
    if path.is_symlink() or not (path.is_dir() if folder else path.is_file()):
        kind = "folder" if folder else "file"
        raise ConfigError(f"--out {target}: '{name}' there is in the way of a {kind} of the results; move it away")


def _put_in_place(results: Path, place: Path, old: Path, last: Sequence[str]) -> None:
    """Move every file to its place; when one cannot be moved, undo what was done."""
    names = [path.relative_to(results) for path in results.rglob("*") if path.is_file()]
    names.sort(key=lambda name: (last.index(str(name)) if str(name) in last else -1, name))
    done: list[Path] = []
    with ExitStack() as made:
        try:
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
