"""Drive the runs of a campaign that are not there yet, and give the rows of all of them.

Every command that drives many runs goes through `drive_all`: an interrupted campaign is continued, and runs that were
driven before are not repeated.
"""

from __future__ import annotations

import hashlib
import json
import platform
import shutil
import time
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from diffdrive_mpc.bench.progress import ProgressBar
from diffdrive_mpc.bench.runner import (
    OnDone,
    StudyFailedError,
    WorkerDiedError,
    available_cores,
    keeps_processes,
    run_tasks,
)
from diffdrive_mpc.models.checked_yaml import ConfigError, parse_json
from diffdrive_mpc.models.input_file import MEGABYTE, read_input
from diffdrive_mpc.models.table import plain_line
from diffdrive_mpc.models.whole_file import reason, whole_file
from diffdrive_mpc_extras.campaign.definition import LIBRARIES, Definition, identify, key_of
from diffdrive_mpc_extras.campaign.drive import Row, built, drive


def check_definitions(definitions: Sequence[Definition]) -> None:
    """Build a run for each name that occurs, and for the least and the largest value of each number.

    Combinations of them are not all built: a run that cannot be has its error in its row.

    Raises ConfigError, which names the factor, if one cannot be built.
    """
    for index, factor in sorted(_telling(definitions).items()):
        try:
            with built(definitions[index]):
                pass
        except ValueError as error:
            raise ConfigError(f"a run with {factor}: {error}") from error


def _telling(definitions: Sequence[Definition]) -> dict[int, str]:
    """Return runs to build, each with its factor for messages."""
    named: dict[tuple[str, object], int] = {}
    least: dict[str, tuple[float, int]] = {}
    largest: dict[str, tuple[float, int]] = {}
    for index, definition in enumerate(definitions):
        for name, value in definition.factors.items():
            if isinstance(value, (int, float)) and not isinstance(value, bool) and name != "seed":
                least[name] = min(least.get(name, (value, index)), (value, index))
                largest[name] = max(largest.get(name, (value, index)), (value, index))
            elif name != "seed":
                named.setdefault((name, value), index)
    named_values = {index: f"{name} = {value}" for (name, value), index in named.items()}
    ends = [(name, end) for ends in (least, largest) for name, end in ends.items()]
    return named_values | {index: f"{name} = {value:g}" for name, (value, index) in ends}


# One run on its way to the process that drives it.


class OtherVersionError(StudyFailedError):
    """Error for code, libraries or files that differ from those of the request."""


@dataclass(frozen=True)
class CampaignTask:
    """A run, and the key under which it is kept."""

    definition: Definition
    key: str

    @classmethod
    def for_run(cls, definition: Definition) -> CampaignTask:
        """Build the task for a run."""
        return cls(definition, key_of(definition))

    @property
    def identity(self) -> dict[str, object]:
        """Data behind the hash in the key."""
        return identify(self.definition)


def do(task: CampaignTask) -> Row:
    """Drive the run and give its row; raises OtherVersionError where it would be another run than the requested one."""
    if key_of(task.definition) != task.key:
        raise OtherVersionError(
            f"{platform.node()} has another version of this product, of Python or of {', '.join(LIBRARIES)}, or other "
            "files than where the campaign was started; install the same, and share the files that the campaign names"
        )
    return drive(task.definition)


# Rows of runs in a folder, one file for each, under the hash of what defines the run.


RUNS = "runs"
_ALWAYS = {"completed", "error"}
"""Columns of every row."""
_CELL = (bool, int, float, str, type(None))
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
        """Remove files of writers that were ended from outside."""
        for draft in self._folder.glob("*/.unfinished-*"):
            with suppress(FileNotFoundError):  # another process has just put its file in place
                if time.time() - draft.stat().st_mtime > _LEFT_OVER:
                    shutil.rmtree(draft, ignore_errors=True)

    def keys(self) -> set[str]:
        """Return the keys of all stored runs."""
        return {path.stem for path in self._folder.glob("*/*.json")}

    def save(self, key: str, identity: dict[str, object], row: Row) -> None:
        """Store the row of the run with `key`, and with it all data that the key is the hash of."""
        record = {"key": key, **identity, "row": row, "sums": _sums(key, row)}
        with whole_file(self._path(key), rewrites=True) as draft:
            draft.write_text(json.dumps(record, indent=1, allow_nan=False) + "\n", encoding="utf-8")

    def load(self, key: str) -> Row | None:
        """Load the row of a run; None if it is missing or damaged, as by a full disk.

        Raises ConfigError if a figure of the row is not the one that was saved.
        """
        path = self._path(key)
        try:
            record: Any = parse_json(read_input(path, MEGABYTE))
            row, sums = record["row"], record["sums"]
        except (OSError, ValueError, KeyError, TypeError):
            return None
        if not (isinstance(row, dict) and isinstance(sums, dict) and row.keys() >= _ALWAYS):
            return None
        if not all(isinstance(value, _CELL) for value in row.values()):
            return None
        now = _sums(key, row)
        changed = sorted(name for name in {*now, *sums} if now.get(name) != sums.get(name))
        if changed:
            raise ConfigError(
                f"{path}: run {key[:12]}, column '{changed[0]}': not what was saved (found "
                f"{plain_line(repr(row.get(changed[0])), 40)}); remove the file, and the run is driven again"
            )
        return row

    def _path(self, key: str) -> Path:
        return self._folder / key[:2] / f"{key}.json"


def _sums(key: str, row: Row) -> dict[str, str]:
    """Return a checksum for each figure, over key, column and value: it finds a file that was edited or exchanged."""
    cells = {name: json.dumps([key, name, value]).encode() for name, value in row.items()}
    return {name: hashlib.sha256(cell).hexdigest()[:16] for name, cell in cells.items()}


# Drive runs in processes of this machine.


_WORTH = 8
"""A process that starts and ends with the runs costs as much time as this number of runs."""
_TRIES = 3
"""Number of pools in a row that may break without a finished run in between."""


def drive_here(tasks: Iterable[CampaignTask], folder: Path, jobs: int, on_done: OnDone) -> None:
    """Drive every run that the store in `folder` does not have, in `jobs` processes at most; each keeps its own.

    Runs of a process that was ended from outside are done again. Raises WorkerDiedError when that does not help,
    OtherVersionError if a file that a run names changed meanwhile.
    """
    left, tries = list(tasks), 0
    while left:
        try:
            processes = min(jobs, max(1, len(left) // (1 if keeps_processes() else _WORTH)))
            run_tasks([partial(_keep, task, folder) for task in left], processes, on_done)
            return
        except WorkerDiedError:
            stored = Store(folder).keys()
            fewer = [task for task in left if task.key not in stored]
            tries = 0 if len(fewer) < len(left) else tries + 1
            if tries == _TRIES:
                raise
            left = fewer


def _keep(task: CampaignTask, folder: Path) -> None:
    row = do(task)
    Store(folder).save(task.key, task.identity, row)


@dataclass(frozen=True)
class CampaignRun:
    """A run of a campaign and its result.

    Attributes
    ----------
    definition
        Definition of the run.
    key
        The hash under which it is stored.
    row
        Metrics, counts and times by column; see packages/extras/docs/prove.md.
    """

    definition: Definition
    key: str
    row: Row

    def number(self, column: str) -> float:
        """Return a figure of the row; NaN if it is missing."""
        value = self.row.get(column)
        return float("nan") if value is None or isinstance(value, str) else float(value)

    @property
    def columns(self) -> dict[str, object]:
        """Definition and row by column, as the table holds them."""
        return {"run": self.key, **self.definition.columns, **self.row}


@dataclass(frozen=True)
class CampaignPlace:
    """Place of the runs and of their rows.

    Attributes
    ----------
    folder
        Folder of the store.
    jobs
        Processes on this machine; None for one for each core.
    """

    folder: Path
    jobs: int | None = None


def drive_all(
    definitions: Sequence[Definition],
    place: CampaignPlace,
    bar: ProgressBar,
    text: str = "driving",
) -> list[CampaignRun]:
    """Drive those runs that the store does not have, and give all in order; a run that is named twice counts once.

    Parameters
    ----------
    definitions
        Definitions of the runs.
    place
        Store and workers of the runs.
    bar
        Shows how far it is.
    text
        Text of the progress bar.

    Raises ConfigError where the store cannot be written to, a stored row was changed, or a run cannot be built, before
    anything is driven;
    StudyFailedError where runs could not be driven.
    """
    tasks = list({task.key: task for task in map(CampaignTask.for_run, definitions)}.values())
    store = Store(place.folder)
    store.clear_drafts()
    stored = store.keys()
    missing = [task for task in tasks if task.key not in stored or store.load(task.key) is None]
    check_definitions([task.definition for task in missing])
    jobs = place.jobs or available_cores()
    bar.start_stage(f"{text}, {jobs} at a time", len(missing))
    if missing:
        drive_here(missing, place.folder, jobs, bar.advance)
    driven = []
    for task in tasks:
        row = store.load(task.key)
        if row is None:
            raise StudyFailedError(f"{place.folder}: run {task.key[:12]} was taken away while the campaign went on")
        driven.append(CampaignRun(task.definition, task.key, row))
    return driven


def failed(driven: Sequence[CampaignRun]) -> str:
    """Describe the number of runs with an error, and the first error, in one line; empty without any."""
    errors = [run for run in driven if run.row["error"]]
    if not errors:
        return ""
    first = errors[0]
    return f"{len(errors)} of {len(driven)} runs ended in an error; run {first.key[:12]}: {first.row['error']}"
