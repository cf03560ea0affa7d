"""Rows of runs in a folder, one file for each, under the hash of what defines the run.

Files appear whole or not at all, and a run has the same name everywhere: folders of several machines are merged by
copying one into the other.
"""

from __future__ import annotations

import json
import shutil
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

from diffdrive_mpc.bench.campaign.outcome import Row
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.whole_file import reason, whole_file

RUNS = "runs"
_LEFT_OVER = 3600.0
"""A draft that is older [s] has lost its writer."""


class Store:
    """The runs in `folder`/runs, which is made where missing; raises ConfigError if that cannot be."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder / RUNS
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ConfigError(f"--out {folder}: cannot be written to ({reason(error)}); give a folder") from error

    def clear_drafts(self) -> None:
        """Remove what writers left that were ended from outside."""
        for draft in self._folder.glob("*/.unfinished-*"):
            with suppress(FileNotFoundError):  # another process has just put its file in place
                if time.time() - draft.stat().st_mtime > _LEFT_OVER:
                    shutil.rmtree(draft, ignore_errors=True)

    def keys(self) -> set[str]:
        """Of all runs that are there."""
        return {path.stem for path in self._folder.glob("*/*.json")}

    def save(self, key: str, identity: dict[str, object], row: Row) -> None:
        """Keep the row of the run with `key`, and beside it all that the key is the hash of."""
        record = {"key": key, **identity, "row": row}
        with whole_file(self._path(key)) as draft:
            draft.write_text(json.dumps(record, indent=1, allow_nan=False) + "\n", encoding="utf-8")

    def load(self, key: str) -> Row | None:
        """The row of a run; None where there is none, or a file that was cut off (by a disk that was full)."""
        path = self._path(key)
        try:
            record: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
            row: Row = record["row"]
        except (FileNotFoundError, ValueError, KeyError, TypeError):
            return None
        return row

    def _path(self, key: str) -> Path:
        return self._folder / key[:2] / f"{key}.json"
