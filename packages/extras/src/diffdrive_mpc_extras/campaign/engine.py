"""Engine of campaigns: simulate the runs that are not stored yet, and return the rows of all runs.

All commands with many runs use `drive_all`, which continues an interrupted campaign and does not repeat stored runs.
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
    are_processes_persistent,
    available_cores,
    run_tasks,
)
from diffdrive_mpc.models.checked_yaml import ConfigError, parse_json
from diffdrive_mpc.models.input_file import MEGABYTE, read_input
from diffdrive_mpc.models.table import plain_line
from diffdrive_mpc.models.whole_file import reason, whole_file
from diffdrive_mpc_extras.campaign.definition import LIBRARIES, Definition, identify, key_of
from diffdrive_mpc_extras.campaign.drive import Row, built, drive


def check_definitions(definitions: Sequence[Definition]) -> None:
    """Build a run for each name, and for the minimum and the maximum of each numeric factor.

    Combinations of values are not checked; a run that cannot be built has the error in its row.

    Raises ConfigError, which names the factor, if a run cannot be built.
    """
    for index, factor in sorted(_extreme_runs(definitions).items()):
        try:
            with built(definitions[index]):
                pass
        except ValueError as error:
            raise ConfigError(f"a run with {factor}: {error}") from error


def _extreme_runs(definitions: Sequence[Definition]) -> dict[int, str]:
    """Return the indices of the runs to build, each with its factor for messages."""
    names: dict[tuple[str, object], int] = {}
    minima: dict[str, tuple[float, int]] = {}
    maxima: dict[str, tuple[float, int]] = {}
    for index, definition in enumerate(definitions):
        for name, value in definition.factors.items():
            if isinstance(value, (int, float)) and not isinstance(value, bool) and name != "seed":
                minima[name] = min(minima.get(name, (value, index)), (value, index))
                maxima[name] = max(maxima.get(name, (value, index)), (value, index))
            elif name != "seed":
                names.setdefault((name, value), index)
    named_runs = {index: f"{name} = {value}" for (name, value), index in names.items()}
    extremes = [(name, end) for ends in (minima, maxima) for name, end in ends.items()]
    return named_runs | {index: f"{name} = {value:g}" for name, (value, index) in extremes}


# Task of one run, as sent to a worker process.


class OtherVersionError(StudyFailedError):
    """Error if code, libraries or files differ between the worker and the process that started the campaign."""


@dataclass(frozen=True)
class CampaignTask:
    """Run, and the key under which it is stored."""

    definition: Definition
    key: str

    @classmethod
    def for_run(cls, definition: Definition) -> CampaignTask:
        """Build the task of a run."""
        return cls(definition, key_of(definition))

    @property
    def identity(self) -> dict[str, object]:
        """Data whose hash is the key."""
        return identify(self.definition)


def run_task(task: CampaignTask) -> Row:
    """Simulate the run and return its row; raises OtherVersionError if its key differs in this process."""
    if key_of(task.definition) != task.key:
        raise OtherVersionError(
            f"{platform.node()} has a different version of this product, of Python or of {', '.join(LIBRARIES)}, or "
            "different files; install the versions of the starting machine, and share the files of the campaign"
        )
    return drive(task.definition)


# Store of rows in a folder, one file per run, named by the hash of its definition.


RUNS = "runs"
_REQUIRED_COLUMNS = {"completed", "error"}
"""Columns that each row must have."""
_CELL_TYPES = (bool, int, float, str, type(None))
_MAX_DRAFT_AGE = 3600.0
"""Age above which a draft counts as abandoned [s]."""


class Store:
    """Store of runs in `folder`/runs, which is created if missing; raises ConfigError if this fails."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder / RUNS
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ConfigError(f"--out {folder}: cannot be written to ({reason(error)}); give a folder") from error

    def clear_drafts(self) -> None:
        """Remove files of writers that were killed."""
        for draft in self._folder.glob("*/.unfinished-*"):
            with suppress(FileNotFoundError):  # another process has just completed its file
                if time.time() - draft.stat().st_mtime > _MAX_DRAFT_AGE:
                    shutil.rmtree(draft, ignore_errors=True)

    def keys(self) -> set[str]:
        """Return the keys of all stored runs."""
        return {path.stem for path in self._folder.glob("*/*.json")}

    def save(self, key: str, identity: dict[str, object], row: Row) -> None:
        """Store the row of the run with `key`, together with the data whose hash is the key."""
        record = {"key": key, **identity, "row": row, "sums": _checksums(key, row)}
        with whole_file(self._path(key), rewrites=True) as draft:
            draft.write_text(json.dumps(record, indent=1, allow_nan=False) + "\n", encoding="utf-8")

    def load(self, key: str) -> Row | None:
        """Load the row of a run; None if it is missing or damaged, for example by a full disk.

        Raises ConfigError if a value of the row differs from its checksum.
        """
        path = self._path(key)
        try:
            record: Any = parse_json(read_input(path, MEGABYTE))
            row, sums = record["row"], record["sums"]
        except (OSError, ValueError, KeyError, TypeError):
            return None
        if not (isinstance(row, dict) and isinstance(sums, dict) and row.keys() >= _REQUIRED_COLUMNS):
            return None
        if not all(isinstance(value, _CELL_TYPES) for value in row.values()):
            return None
        row_sums = _checksums(key, row)
        changed = sorted(name for name in {*row_sums, *sums} if row_sums.get(name) != sums.get(name))
        if changed:
            raise ConfigError(
                f"{path}: run {key[:12]}, column '{changed[0]}': changed since it was saved (found "
                f"{plain_line(repr(row.get(changed[0])), 40)}); remove the file to repeat the run"
            )
        return row

    def _path(self, key: str) -> Path:
        return self._folder / key[:2] / f"{key}.json"


def _checksums(key: str, row: Row) -> dict[str, str]:
    """Return a checksum for each value, over key, column and value, to detect edited and exchanged files."""
    cells = {name: json.dumps([key, name, value]).encode() for name, value in row.items()}
    return {name: hashlib.sha256(cell).hexdigest()[:16] for name, cell in cells.items()}


# Simulation of runs in processes of this machine.
_START_COST = 8
"""Cost of starting a process, as a number of runs."""
_MAX_TRIES = 3
"""Maximum number of consecutive broken pools without a finished run."""


def drive_here(tasks: Iterable[CampaignTask], folder: Path, jobs: int, on_done: OnDone) -> None:
    """Simulate `tasks` in at most `jobs` processes, and store their rows in `folder`.

    Runs of a killed process are repeated. Raises WorkerDiedError if the repetition fails too often, and
    OtherVersionError if a file of a run changed meanwhile.
    """
    remaining, tries = list(tasks), 0
    while remaining:
        try:
            processes = min(jobs, max(1, len(remaining) // (1 if are_processes_persistent() else _START_COST)))
            run_tasks([partial(_run_and_store, task, folder) for task in remaining], processes, on_done)
            return
        except WorkerDiedError:
            stored = Store(folder).keys()
            unfinished = [task for task in remaining if task.key not in stored]
            tries = 0 if len(unfinished) < len(remaining) else tries + 1
            if tries == _MAX_TRIES:
                raise
            remaining = unfinished


def _run_and_store(task: CampaignTask, folder: Path) -> None:
    row = run_task(task)
    Store(folder).save(task.key, task.identity, row)


@dataclass(frozen=True)
class CampaignRun:
    """Run of a campaign with its result.

    Attributes
    ----------
    definition
        Definition of the run.
    key
        Hash under which the run is stored.
    row
        Metrics, counts and times by column; see packages/extras/docs/prove.md.
    """

    definition: Definition
    key: str
    row: Row

    def number(self, column: str) -> float:
        """Return a numeric value of the row; NaN if it is missing."""
        value = self.row.get(column)
        return float("nan") if value is None or isinstance(value, str) else float(value)

    @property
    def columns(self) -> dict[str, object]:
        """Definition and row by column of the table."""
        return {"run": self.key, **self.definition.columns, **self.row}


@dataclass(frozen=True)
class CampaignPlace:
    """Folder and number of processes of a campaign.

    Attributes
    ----------
    folder
        Folder of the store.
    jobs
        Number of processes; None for the number of cores.
    """

    folder: Path
    jobs: int | None = None


def drive_all(
    definitions: Sequence[Definition],
    place: CampaignPlace,
    bar: ProgressBar,
    text: str = "driving",
) -> list[CampaignRun]:
    """Drive those runs that the store does not have, and give all in order; a run that is names twice counts once.

    Parameters
    ----------
    definitions
        Definitions of the runs.
    place
        Store and number of processes.
    bar
        Progress bar.
    text
        Text of the progress bar.

    Raises ConfigError, before the first run, if the store is not writable, a stored row was changed, or a run cannot be
    built; raises StudyFailedError if runs fail.
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
    runs = []
    for task in tasks:
        row = store.load(task.key)
        if row is None:
            raise StudyFailedError(f"{place.folder}: run {task.key[:12]} was removed during the campaign")
        runs.append(CampaignRun(task.definition, task.key, row))
    return runs


def describe_errors(runs: Sequence[CampaignRun]) -> str:
    """Return the number of runs with an error and the first error, in one line; empty if there is no error."""
    errors = [run for run in runs if run.row["error"]]
    if not errors:
        return ""
    first = errors[0]
    return f"{len(errors)} of {len(runs)} runs ended in an error; run {first.key[:12]}: {first.row['error']}"
