"""Run the cases of the study in several processes, each of which keeps only rows."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from joblib import Parallel, delayed, parallel_config
from joblib.externals.loky import get_reusable_executor
from threadpoolctl import threadpool_limits

from diffdrive_mpc.bench.case import Case
from diffdrive_mpc.bench.tracking.row import Row, run_row


def run_rows(
    cases: Sequence[Case], trajectories: tuple[str, ...], jobs: int, on_done: Callable[[], None]
) -> dict[Case, Row]:
    """Run and reduce cases in `jobs` processes, one BLAS thread each; the result does not depend on `jobs`.

    Parameters
    ----------
    cases
        What to run, each once.
    trajectories
        What the bound's knowledge of the plant is fitted on.
    jobs
        Number of processes.
    on_done
        Called after each run.
    """
    if jobs == 1:
        with threadpool_limits(limits=1):
            return {case: _announced(run_row(case, trajectories), on_done) for case in cases}
    try:
        with parallel_config(backend="loky", n_jobs=jobs, inner_max_num_threads=1):
            rows = Parallel(return_as="generator")(delayed(run_row)(case, trajectories) for case in cases)
            return {case: _announced(row, on_done) for case, row in zip(cases, rows, strict=True)}
    finally:
        get_reusable_executor().shutdown(wait=True)


def _announced(row: Row, on_done: Callable[[], None]) -> Row:
    on_done()
    return row
