"""Drive runs in processes of this machine."""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial
from pathlib import Path

from diffdrive_mpc.bench.campaign.store import Store
from diffdrive_mpc.bench.campaign.task import Task, do
from diffdrive_mpc.bench.errors import WorkerDiedError
from diffdrive_mpc.bench.runner import OnDone, processes_last, run_tasks

_WORTH = 8
"""A process that starts, and ends with the runs, costs as much as so many of them."""
_TRIES = 3
"""So many pools in a row may break without a run done in between."""


def drive_here(tasks: Iterable[Task], folder: Path, jobs: int, on_done: OnDone) -> None:
    """Drive every run that the store in `folder` does not have, in `jobs` processes at most; each keeps its own.

    Runs of a process that was ended from outside are done again. Raises WorkerDiedError when that does not help,
    OtherVersionError if a file that a run names changed meanwhile.
    """
    left, tries = list(tasks), 0
    while left:
        try:
            processes = min(jobs, max(1, len(left) // (1 if processes_last() else _WORTH)))
            run_tasks([partial(_keep, task, folder) for task in left], processes, on_done)
            return
        except WorkerDiedError:
            kept = Store(folder).keys()
            fewer = [task for task in left if task.key not in kept]
            tries = 0 if len(fewer) < len(left) else tries + 1
            if tries == _TRIES:
                raise
            left = fewer


def _keep(task: Task, folder: Path) -> None:
    row = do(task)
    Store(folder).save(task.key, task.identity, row)
