"""The process pool of all studies."""

from __future__ import annotations

import os
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache, partial
from typing import TypeVar

from threadpoolctl import threadpool_limits

from diffdrive_mpc.models.errors import DiffdriveMpcError, FormerNameWarning

# Failures of a study that are no mistakes of the user; each message is one line.


class StudyFailedError(DiffdriveMpcError, RuntimeError):
    """A study could not be finished."""


class NotReproducibleError(StudyFailedError):
    """The same measurements gave other commands when they were replayed."""


class WorkerDiedError(StudyFailedError):
    """A process that ran a part of a study ended without a result."""


T = TypeVar("T")
OnDone = Callable[[], None]
_LOOKS_EVERY = 1.0
"""Period of the check for the parent process [s]."""
_LASTING: ContextVar[bool] = ContextVar("processes last", default=False)


def available_cores() -> int:
    """Count the cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def lasting_processes() -> Iterator[None]:
    """Keep processes of `run_tasks` alive between calls inside the context."""
    before = _LASTING.set(True)
    try:
        yield
    finally:
        _LASTING.reset(before)
        _end_processes(at_once=False)


def processes_last() -> bool:
    """Return True if a started process serves several calls of `run_tasks`."""
    return _LASTING.get()


def run_tasks(tasks: Sequence[Callable[[], T]], jobs: int, on_done: OnDone) -> list[T]:
    """Call every task with one BLAS thread, in `jobs` processes, and `on_done` after each.

    An exception of a task is raised here, and ends the others.

    Returns
    -------
    list
        In the order of `tasks`; the result does not depend on `jobs`.

    Raises
    ------
    WorkerDiedError
        If a process was ended from outside, for instance because the memory was full.
    """
    results = {}
    if jobs == 1 or len(tasks) < 2:
        with threadpool_limits(limits=1):
            for number, task in enumerate(tasks):
                results[number] = task()
                on_done()
    else:
        for number, result in _in_processes([partial(_numbered, *entry) for entry in enumerate(tasks)], jobs):
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
        raise WorkerDiedError(f"one of {jobs} processes was ended from outside; try a smaller --jobs") from error
    finally:
        # Idle workers would disturb the timing that follows; those of a failed study are not waited for.
        if not (finished and processes_last()):
            _end_processes(at_once=not finished)


def _end_processes(*, at_once: bool) -> None:
    from joblib.externals.loky import get_reusable_executor  # noqa: PLC0415 - see run_tasks

    pool = get_reusable_executor(reuse=True, kill_workers=at_once)
    pool.shutdown(wait=True, kill_workers=at_once)


def _numbered(number: int, task: Callable[[], T]) -> tuple[int, T]:
    return number, task()


def _call(task: Callable[[], T]) -> T:
    _end_with_parent()
    # The parent process has read the same file, and reported it.
    warnings.simplefilter("ignore", FormerNameWarning)
    return task()


@cache
def _end_with_parent() -> None:
    """End this process soon after its parent, even if the parent was killed."""
    parent = os.getppid()

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(_LOOKS_EVERY)
        os._exit(1)

    threading.Thread(target=watch, name="watches its parent", daemon=True).start()
