"""Drive runs on the workers of a Dask scheduler; workers and scheduler may be lost and come back."""

from __future__ import annotations

import asyncio
import logging
import queue
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any

from diffdrive_mpc.bench.runner import StudyFailedError, WorkerDiedError
from diffdrive_mpc.models.errors import MissingPackageError
from diffdrive_mpc_extras.campaign.drive import Row
from diffdrive_mpc_extras.campaign.engine import CampaignTask, do

OnRow = Callable[[CampaignTask, Row], None]

_CONNECT = 10.0
"""So long a scheduler may take to answer [s]."""
_LOOK = 1.0
"""So often it is looked whether the scheduler is there [s]."""
_AHEAD = 4
"""Runs that are sent for each thread of the workers: the next is there when one is done, and few are sent in vain."""
_LEAST_AHEAD = 16
_FATAL_TRIES = 5
"""A run that was lost with its worker so many times ends its workers itself."""


class SchedulerLostError(StudyFailedError):
    """There is no answer from the scheduler."""


def drive_there(tasks: Sequence[CampaignTask], scheduler: str, on_row: OnRow, patience: float = 600.0) -> None:
    """Drive every run on the workers of `scheduler`; `on_row` is called here, once for each run.

    What was under way on a worker or a scheduler that is lost is sent again. Without a scheduler or an answer from it
    for longer than `patience` [s] SchedulerLostError is raised, at the first connection after ten seconds;
    WorkerDiedError where a run ends its worker again and again, and what a run itself raised.
    """
    # What it has to say of workers that come and go is told by the progress.
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    left = {task.key: task for task in tasks}
    losses: dict[str, int] = {}
    first, since = True, time.monotonic()

    def done(task: CampaignTask, row: Row) -> None:
        nonlocal since
        since = time.monotonic()
        if left.pop(task.key, None) is not None:
            on_row(task, row)

    while left:
        try:
            client = _connect(scheduler)
        except (OSError, TimeoutError) as error:
            if first or time.monotonic() - since > patience:
                raise SchedulerLostError(
                    f"--scheduler {scheduler}: no answer; start it with `dask scheduler` and its workers with "
                    "`dask worker`, and name the address that it prints"
                ) from error
            time.sleep(_LOOK)
            continue
        first = False
        try:
            _Session(client, losses, done, patience).drive(list(left.values()))
        except SchedulerLostError:
            if time.monotonic() - since > patience:
                raise
        finally:
            _close(client)


class _Session:
    """What is under way by one connection."""

    def __init__(self, client: Any, losses: dict[str, int], done: OnRow, patience: float) -> None:  # noqa: ANN401
        self._client, self._losses, self._done, self._patience = client, losses, done, patience
        self._finished: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._under_way: dict[str, tuple[CampaignTask, Any]] = {}

    def drive(self, tasks: Sequence[CampaignTask]) -> None:
        """Drive them all; raises SchedulerLostError when the connection is gone."""
        waiting = deque(tasks)
        looked = answered = working = time.monotonic()
        room = self._room()
        while waiting or self._under_way:
            for _ in range(min(room - len(self._under_way), len(waiting))):
                self._send(waiting.popleft())
            with suppress(queue.Empty):
                again = self._take(self._finished.get(timeout=_LOOK))
                if again is not None:
                    waiting.append(again)
            now = time.monotonic()
            if now - looked < _LOOK:
                continue
            looked = now
            if self._client.status != "running":
                if now - answered > _CONNECT:
                    raise SchedulerLostError("the scheduler no longer answers")
                continue
            answered, room = now, self._room()
            working = now if room else working
            if now - working > self._patience:
                raise SchedulerLostError(
                    f"the scheduler has had no worker for {self._patience:.0f} s; start `dask worker`"
                )

    def _send(self, task: CampaignTask) -> None:
        # Another name for a run that is sent again: the scheduler keeps why the first was lost.
        name = f"{task.key}-{self._losses.get(task.key, 0)}"
        future = self._client.submit(do, task, key=name, pure=False)
        self._under_way[task.key] = task, future
        future.add_done_callback(lambda _, key=task.key: self._finished.put(key))

    def _take(self, key: str) -> CampaignTask | None:
        """Take what came of a run; gives the task where it has to be sent again."""
        from distributed import KilledWorker  # noqa: PLC0415 - see drive_there
        from distributed.client import FutureCancelledError  # noqa: PLC0415

        task, future = self._under_way.pop(key)
        if future.status == "cancelled":
            raise SchedulerLostError("the scheduler has forgotten what was under way")
        try:
            row = future.result(timeout=_CONNECT)
        except KilledWorker as error:
            self._losses[key] = self._losses.get(key, 0) + 1
            if self._losses[key] >= _FATAL_TRIES:
                raise WorkerDiedError(
                    f"run {key[:12]} was lost with its worker again and again; has the worker enough memory?"
                ) from error
            return task
        except (FutureCancelledError, asyncio.CancelledError, TimeoutError, OSError) as error:
            raise SchedulerLostError("the scheduler was lost") from error
        self._done(task, row)
        return None

    def _room(self) -> int:
        """How many runs may be under way; 0 without a worker."""
        try:
            threads = sum(self._client.nthreads().values())
        except OSError as error:
            raise SchedulerLostError("the scheduler was lost") from error
        return max(_LEAST_AHEAD, _AHEAD * threads) if threads else 0


def _connect(scheduler: str) -> Any:  # noqa: ANN401 - has no types
    try:
        from distributed import Client  # noqa: PLC0415 - only needed with --scheduler
    except ImportError as error:
        raise MissingPackageError("--scheduler needs Dask: pip install diffdrive-mpc[campaign]") from error
    connect: Any = Client
    return connect(scheduler, timeout=_CONNECT, set_as_default=False, name="diffdrive-mpc campaign")


def _close(client: Any) -> None:  # noqa: ANN401 - has no types
    with suppress(OSError, TimeoutError, RuntimeError, AssertionError):
        client.close(timeout=1.0)
