"""Joblib's Dask backend, which also raises the error of a task that never ran."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from typing import Any

from joblib._dask import DaskDistributedBackend


class DaskBackend(DaskDistributedBackend):  # type: ignore[misc]
    """Backend whose `Parallel` ends if a task is lost.

    Joblib 1.6 calls back for results only: after `KilledWorker` its generator waits forever.
    """

    def submit(self, func: Any, callback: Callable[[Any], None] | None = None) -> Any:  # noqa: ANN401 - has no types
        """Submit a batch of tasks, and call back with the error of a batch that was lost."""

        def report_error(future: Future[Any]) -> None:
            if callback is not None and future.exception() is not None:
                callback(future.exception())

        submitted = super().submit(func, callback)
        submitted.add_done_callback(report_error)
        return submitted

    def retrieve_result_callback(self, out: Any) -> Any:  # noqa: ANN401 - has no types
        """Return the results of a batch, or raise its error."""
        if isinstance(out, BaseException):
            raise out
        return super().retrieve_result_callback(out)

    def effective_n_jobs(self, n_jobs: int) -> int:
        """Return the number of threads of all workers, at least 2: joblib runs the tasks of one in this process."""
        return max(2, int(super().effective_n_jobs(n_jobs)))
