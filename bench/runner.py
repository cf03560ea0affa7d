"""The process pool of all studies: processes of this machine, or the workers of a Dask cluster."""

from __future__ import annotations

import logging
import os
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from functools import cache, partial
from typing import Any, TypeVar

from threadpoolctl import threadpool_limits

from diffdrive_mpc.models.errors import DiffdriveMpcError, FormerNameWarning, MissingPackageError

# What can go wrong in a study that is no mistake of the user's; each is one line.


class StudyFailedError(DiffdriveMpcError, RuntimeError):
    """A study could not be finished."""


class NotReproducibleError(StudyFailedError):
    """The same measurements gave other commands when they were replayed."""


class WorkerDiedError(StudyFailedError):
    """A process that ran a part of a study ended without a result."""


class SchedulerLostError(StudyFailedError):
    """A Dask scheduler does not answer, or has no worker."""


T = TypeVar("T")
OnDone = Callable[[], None]
_LOOKS_EVERY = 1.0
"""Whether the parent is there [s]."""
_CONNECT, _WAIT_FOR_WORKERS = 10.0, 60.0
"""Timeouts of a Dask scheduler: until it answers, and until it has a worker [s]."""
_LASTING: ContextVar[bool] = ContextVar("processes last", default=False)


def available_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def lasting_processes() -> Iterator[None]:
    """Processes that `run_tasks` starts within wait for its next call, and end with this."""
    before = _LASTING.set(True)
    try:
        yield
    finally:
        _LASTING.reset(before)
        _end_processes(at_once=False)


def processes_last() -> bool:
    """Whether a process that is started serves several calls of `run_tasks`."""
    return _LASTING.get()


@contextmanager
def cluster(scheduler: str) -> Iterator[None]:
    """Run the tasks of `run_tasks` on the workers of a Dask scheduler; on this machine if the address is empty.

    The context is joblib's Dask backend: `joblib.parallel_config(backend="dask")` has the same effect.

    Raises
    ------
    MissingPackageError
        If Dask is not installed.
    SchedulerLostError
        If the scheduler does not answer, or has no worker.
    """
    if not scheduler:
        yield
        return
    try:
        from distributed import Client  # noqa: PLC0415 - only needed with a scheduler
    except ImportError as error:
        raise MissingPackageError("--scheduler needs Dask: pip install diffdrive-mpc[campaign]") from error
    from joblib import parallel_config  # noqa: PLC0415 - see finished_tasks

    # The progress bar shows what lost workers mean for the study.
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    connect: Any = Client
    try:
        client = connect(scheduler, timeout=_CONNECT, set_as_default=False, name="diffdrive-mpc")
    except (OSError, TimeoutError) as error:
        raise SchedulerLostError(
            f"--scheduler {scheduler}: no answer; start it with `dask scheduler` and its workers with `dask worker`, "
            "and name the address that it prints"
        ) from error
    try:
        if not _has_worker(client):
            raise SchedulerLostError(f"--scheduler {scheduler}: it has no worker; start `dask worker`")
        with parallel_config(backend="dask", client=client):
            yield
    finally:
        with suppress(OSError, TimeoutError, RuntimeError, AssertionError):  # the scheduler may be lost
            client.close(timeout=1.0)


def _has_worker(client: Any) -> bool:  # noqa: ANN401 - has no types
    with suppress(TimeoutError):
        client.wait_for_workers(1, timeout=_WAIT_FOR_WORKERS)
        return True
    return False


def is_on_cluster() -> bool:
    """Return True inside joblib's Dask backend."""
    return _cluster_client() is not None


def _cluster_client() -> Any:  # noqa: ANN401 - has no types
    joblib = sys.modules.get("joblib.parallel")
    return None if joblib is None else getattr(joblib.get_active_backend()[0], "client", None)


def run_tasks(tasks: Sequence[Callable[[], T]], jobs: int, on_done: OnDone) -> list[T]:
    """Call every task as `finished_tasks` does, and `on_done` after each.

    Returns
    -------
    list
        In the order of `tasks`; the result does not depend on `jobs` or on a cluster.
    """
    results = {}
    for number, result in finished_tasks(tasks, jobs):
        results[number] = result
        on_done()
    return [results[number] for number in range(len(tasks))]


def finished_tasks(tasks: Sequence[Callable[[], T]], jobs: int) -> Iterator[tuple[int, T]]:
    """Call every task with one BLAS thread, in `jobs` processes or on a cluster; yield number and result when done.

    An exception of a task is raised here, and ends the others. A cluster drives the tasks of a lost worker again.

    Raises
    ------
    WorkerDiedError
        If a process was ended from outside, for instance because the memory was full.
    SchedulerLostError
        If a cluster has lost its scheduler, or has no worker.
    """
    if not is_on_cluster() and (jobs == 1 or len(tasks) < 2):
        with threadpool_limits(limits=1):
            yield from ((number, task()) for number, task in enumerate(tasks))
        return
    numbered = [partial(_numbered, number, task) for number, task in enumerate(tasks)]
    yield from _on_cluster(numbered) if is_on_cluster() else _in_processes(numbered, jobs)


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
        # Workers that idle would disturb what is timed afterwards; those of a study that failed are not waited for.
        if not (finished and processes_last()):
            _end_processes(at_once=not finished)


def _on_cluster(tasks: Sequence[Callable[[], T]]) -> Iterator[T]:
    from distributed import KilledWorker  # noqa: PLC0415 - see cluster
    from distributed.client import FutureCancelledError  # noqa: PLC0415
    from joblib import Parallel, delayed, parallel_config  # noqa: PLC0415 - see _in_processes

    from diffdrive_mpc.bench.dask_backend import DaskBackend  # noqa: PLC0415 - see cluster

    try:
        with parallel_config(backend=DaskBackend(client=_cluster_client())):
            yield from Parallel(return_as="generator_unordered")(delayed(_call_there)(task) for task in tasks)
    except KilledWorker as error:
        raise WorkerDiedError(f"a task ended its worker again and again; has it enough memory? {error}") from error
    except FutureCancelledError as error:
        raise SchedulerLostError("the Dask scheduler was lost; start it and this command again") from error


def _end_processes(*, at_once: bool) -> None:
    from joblib.externals.loky import get_reusable_executor  # noqa: PLC0415 - see run_tasks

    pool = get_reusable_executor(reuse=True, kill_workers=at_once)
    pool.shutdown(wait=True, kill_workers=at_once)


def _numbered(number: int, task: Callable[[], T]) -> tuple[int, T]:
    return number, task()


def _call(task: Callable[[], T]) -> T:
    _end_with_parent()
    # The process that began this one has read the same file, and told of it.
    warnings.simplefilter("ignore", FormerNameWarning)
    return task()


def _call_there(task: Callable[[], T]) -> T:
    with threadpool_limits(limits=1), warnings.catch_warnings(action="ignore", category=FormerNameWarning):
        return task()


@cache
def _end_with_parent() -> None:
    """Let this process end soon after the one that began it, also where that was killed and could not say so."""
    parent = os.getppid()

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(_LOOKS_EVERY)
        os._exit(1)

    threading.Thread(target=watch, name="watches its parent", daemon=True).start()
