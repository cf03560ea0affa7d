"""Write a folder of results so that it holds the old ones or the new ones, never a mixture that is half written."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from models.checked_yaml import ConfigError


@contextmanager
def staged(target: Path) -> Iterator[Path]:
    """Give a temporary folder to write into; on success its entries replace those of `target`, on failure nothing does.

    Entries of `target` with other names stay.

    Raises
    ------
    models.checked_yaml.ConfigError
        At once, if `target` is a file or cannot be written to.
    """
    existed = target.exists()
    try:
        target.mkdir(parents=True, exist_ok=True)
        stage = Path(tempfile.mkdtemp(prefix=".unfinished-", dir=target))
    except OSError as error:
        raise ConfigError(f"--out {target}: cannot be written to ({error.strerror}); give a folder") from error
    try:
        yield stage
        _move_entries(stage, target)
    finally:
        shutil.rmtree(stage, ignore_errors=True)
        if not existed and not any(target.iterdir()):
            target.rmdir()


def _move_entries(stage: Path, target: Path) -> None:
    with tempfile.TemporaryDirectory(prefix=".replaced-", dir=target) as replaced:
        for entry in sorted(stage.iterdir()):
            place = target / entry.name
            if place.is_dir():
                place.rename(Path(replaced) / entry.name)  # a rename cannot replace a folder that is not empty
            entry.replace(place)
