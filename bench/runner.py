"""Process pool of all studies."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache, partial
from typing import TypeVar

from threadpoolctl import threadpool_limits

from diffdrive_mpc.models.errors import DiffdriveMpcError, wrong_type

# Failures of a study that are not user errors. Every message is a single line.


class StudyFailedError(DiffdriveMpcError, RuntimeError):
    """Error for a study that could not be completed."""


class NotReproducibleError(StudyFailedError):
    """Error for a replay of recorded measurements that computed other commands than the recorded ones."""


class WorkerDiedError(StudyFailedError):
    """Error for a worker process that ended without a result."""


T = TypeVar("T")
OnDone = Callable[[], None]
_PARENT_CHECK_PERIOD = 1.0
"""Period at which a worker checks that its parent process exists [s]."""
_PERSISTENT: ContextVar[bool] = ContextVar("persistent processes", default=False)


def available_cores() -> int:
    """Count the cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def persistent_processes() -> Iterator[None]:
    """Keep the worker processes of `run_tasks` alive between calls within the context."""
    token = _PERSISTENT.set(True)
    try:
        yield
    finally:
        _PERSISTENT.reset(token)
        _end_processes(immediately=False)


def are_processes_persistent() -> bool:
    """Return True if worker processes stay alive between calls of `run_tasks`."""
    return _PERSISTENT.get()


def run_tasks(tasks: Sequence[Callable[[], T]], jobs: int, on_done: OnDone) -> list[T]:
    """Call every task in one of `jobs` processes with one BLAS thread; call `on_done` after each task.

    If a task raises an exception, the other tasks are ended and the exception is raised.

    Returns
    -------
    list
        Results in the order of `tasks`; they do not depend on `jobs`.

    Raises
    ------
    WorkerDiedError
        If a process was killed, for instance because memory was exhausted.
    ArgumentError
        If `jobs` is not an integer from 1.
    """
    if not isinstance(jobs, int) or jobs < 1:
        raise wrong_type("jobs", "a number of processes from 1", jobs, "give 2, or None for one for each core")
    results = {}
    if jobs == 1 or len(tasks) < 2:
        with threadpool_limits(limits=1):
            for number, task in enumerate(tasks):
                results[number] = task()
                on_done()
    else:
        for number, result in _in_processes([partial(_call_numbered, *entry) for entry in enumerate(tasks)], jobs):
            results[number] = result
            on_done()
    return [results[number] for number in range(len(tasks))]


def _in_processes(tasks: Sequence[Callable[[], T]], jobs: int) -> Iterator[T]:
    from joblib import Parallel, delayed, parallel_config  # noqa: PLC0415 - loads slowly, and one run needs no pool
    from joblib.externals.loky.process_executor import BrokenProcessPool  # noqa: PLC0415

    finished = False
    try:
        with parallel_config(backend="loky", n_jobs=jobs, inner_max_num_threads=1):
            yield from Parallel(return_as="generator_unordered")(delayed(_call)(task) for task in tasks)
        finished = True
    except BrokenProcessPool as error:
        raise WorkerDiedError(f"one of {jobs} processes was killed; try a smaller --jobs") from error
    finally:
        # Idle workers would disturb later time measurements; workers of a failed study still compute and are killed.
        if not (finished and are_processes_persistent()):
            _end_processes(immediately=not finished)


def _end_processes(*, immediately: bool) -> None:
    from joblib.externals.loky import get_reusable_executor  # noqa: PLC0415 - see run_tasks

    pool = get_reusable_executor(reuse=True, kill_workers=immediately)
    pool.shutdown(wait=True, kill_workers=immediately)


def _call_numbered(number: int, task: Callable[[], T]) -> tuple[int, T]:
    return number, task()


def _call(task: Callable[[], T]) -> T:
    _end_with_parent()
    return task()


@cache
def _end_with_parent() -> None:
    """End this process shortly after its parent has ended, even if the parent was killed."""
    parent = os.getppid()

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(_PARENT_CHECK_PERIOD)
        os._exit(1)

    threading.Thread(target=watch, name="parent watch", daemon=True).start()
