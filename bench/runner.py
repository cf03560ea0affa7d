"""Run the cases of an experiment: in parallel for the motion, then serially for the step times."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from joblib import Parallel, delayed, parallel_config
from joblib.externals.loky import get_reusable_executor
from threadpoolctl import threadpool_limits

from diffdrive_mpc.bench.case import Case, run_case
from diffdrive_mpc.bench.timing import quiet_core, time_steps
from diffdrive_mpc.sim import Run

Progress = Callable[[], None]


@dataclass(frozen=True)
class Outcome:
    """A case and how it went."""

    case: Case
    run: Run


def available_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def run_cases(cases: Sequence[Case], jobs: int, on_done: Progress) -> list[Outcome]:
    """Run cases in `jobs` processes, one BLAS thread each; `on_done` is called after each.

    Returns
    -------
    list of Outcome
        In the order of `cases`; the result does not depend on `jobs`.
    """
    if jobs == 1:
        with threadpool_limits(limits=1):
            return [_announced(Outcome(case, _recorded(case)), on_done) for case in cases]
    try:
        with parallel_config(backend="loky", n_jobs=jobs, inner_max_num_threads=1):
            runs = Parallel(return_as="generator")(delayed(_recorded)(case) for case in cases)
            return [_announced(Outcome(case, run), on_done) for case, run in zip(cases, runs, strict=True)]
    finally:
        # Workers that idle would still disturb the timing pass that follows.
        get_reusable_executor().shutdown(wait=True)


def time_outcomes(outcomes: Sequence[Outcome], on_done: Progress) -> tuple[list[Outcome], float]:
    """Replace the step times by those of a serial pass on one quiet core.

    Returns
    -------
    outcomes
        With the new step times.
    share
        Processor time over elapsed time of the pass; well below 1, other programs had the core at times, and the
        upper percentiles are theirs.

    Raises
    ------
    bench.errors.NotReproducibleError
        If a replay commanded something else than the run.
    """
    timed = []
    with quiet_core():
        elapsed, used = time.perf_counter(), time.thread_time()
        for outcome in outcomes:
            run = outcome.run.with_step_time(time_steps(outcome.case, outcome.run))
            timed.append(_announced(Outcome(outcome.case, run), on_done))
        share = (time.thread_time() - used) / (time.perf_counter() - elapsed)
    return timed, share


def _recorded(case: Case) -> Run:
    """Run a case and work out its errors where there are several processes to do it."""
    run = run_case(case)
    _ = run.errors
    return run


def _announced(outcome: Outcome, on_done: Progress) -> Outcome:
    on_done()
    return outcome
