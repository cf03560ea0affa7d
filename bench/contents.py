"""Which command wrote what into a folder of results, and who is writing there now."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.folder_lock import lock_folder
from diffdrive_mpc.models.input_file import MEGABYTE, read_input

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
            said: Any = json.loads(read_input(folder / CONTENTS, _LARGEST))
            owners = {str(name): str(one["by"]) for name, one in said.items()}
            states = {str(name): (int(one["bytes"]), int(one["changed_ns"])) for name, one in said.items()}
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
        """What the command wrote there before, and is not in `new`; what somebody has changed since stays."""
        left = [name for name, known in self.owners.items() if known == owner and name not in new]
        return sorted(name for name in left if _state(folder / name) == self.states[name])

    def text(self, folder: Path, owner: str, new: set[str]) -> str:
        """What the folder is to say once the command has written `new`."""
        kept = {name: by for name, by in self.owners.items() if by != owner and name not in new}
        said = {name: (by, self.states[name]) for name, by in kept.items()}
        said |= {name: (owner, _state(folder / name)) for name in new}
        rows = {name: {"by": by, "bytes": size, "changed_ns": time} for name, (by, (size, time)) in said.items()}
        return json.dumps(dict(sorted(rows.items())), indent=0) + "\n"


def _state(path: Path) -> tuple[int, int]:
    found = path.stat()
    return found.st_size, found.st_mtime_ns


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
