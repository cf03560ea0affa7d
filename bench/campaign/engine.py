"""Drive the runs of a campaign that are not there yet, and give the rows of all of them.

Every command that drives many runs goes through `drive_all`: what was interrupted goes on, what was driven before
costs nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from diffdrive_mpc.bench.campaign.check import check_definitions
from diffdrive_mpc.bench.campaign.definition import Definition
from diffdrive_mpc.bench.campaign.local import drive_here
from diffdrive_mpc.bench.campaign.outcome import Row
from diffdrive_mpc.bench.campaign.store import Store
from diffdrive_mpc.bench.campaign.task import Task
from diffdrive_mpc.bench.errors import StudyFailedError
from diffdrive_mpc.bench.progress import ProgressBar
from diffdrive_mpc.bench.runner import available_cores


@dataclass(frozen=True)
class Driven:
    """A run of a campaign and what came of it.

    Attributes
    ----------
    definition
        What was driven.
    key
        The hash under which it is stored.
    row
        Metrics, counts and times by column; see docs/scale.md.
    """

    definition: Definition
    key: str
    row: Row

    def number(self, column: str) -> float:
        """A figure of the row; NaN where it could not be computed."""
        value = self.row.get(column)
        return float("nan") if value is None or isinstance(value, str) else float(value)

    @property
    def columns(self) -> dict[str, object]:
        """Definition and row by column, as the table holds them."""
        return {"run": self.key, **self.definition.columns, **self.row}


@dataclass(frozen=True)
class Place:
    """Where runs are driven, and where their rows are kept.

    Attributes
    ----------
    folder
        Of the store.
    jobs
        Processes on this machine; None for one for each core.
    scheduler
        Address of a Dask scheduler, "tcp://..."; empty to drive here.
    patience
        How long to wait for a scheduler that is gone, or for a worker [s].
    """

    folder: Path
    jobs: int | None = None
    scheduler: str = ""
    patience: float = 600.0


def drive_all(
    definitions: Sequence[Definition],
    place: Place,
    bar: ProgressBar,
    text: str = "driving",
) -> list[Driven]:
    """Drive those runs that the store does not have, and give all in order; a run that is named twice counts once.

    Parameters
    ----------
    definitions
        What to drive.
    place
        Where.
    bar
        Shows how far it is.
    text
        What the bar says.

    Raises ConfigError where the store cannot be written to or a run cannot be built, before anything is driven;
    StudyFailedError where runs could not be driven.
    """
    tasks = list({task.key: task for task in map(Task.of, definitions)}.values())
    store = Store(place.folder)
    store.clear_drafts()
    kept = store.keys()
    missing = [task for task in tasks if task.key not in kept or store.load(task.key) is None]
    check_definitions([task.definition for task in missing])
    jobs = place.jobs or available_cores()
    bar.begin(f"{text}, {place.scheduler or f'{jobs} at a time'}", len(missing))
    if missing and place.scheduler:
        from diffdrive_mpc.bench.campaign.dask_pool import drive_there  # noqa: PLC0415 - needs Dask

        def keep(task: Task, row: Row) -> None:
            store.save(task.key, task.identity, row)
            bar.advance()

        drive_there(missing, place.scheduler, keep, place.patience)
    elif missing:
        drive_here(missing, place.folder, jobs, bar.advance)
    driven = []
    for task in tasks:
        row = store.load(task.key)
        if row is None:
            raise StudyFailedError(f"{place.folder}: run {task.key[:12]} was taken away while the campaign went on")
        driven.append(Driven(task.definition, task.key, row))
    return driven


def failed(driven: Sequence[Driven]) -> str:
    """How many runs ended in an error, and the first of them, in one line; empty without any."""
    errors = [one for one in driven if one.row["error"]]
    if not errors:
        return ""
    first = errors[0]
    return f"{len(errors)} of {len(driven)} runs ended in an error; run {first.key[:12]}: {first.row['error']}"
