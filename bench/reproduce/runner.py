"""Run the parts: repetitions in several processes, then, on a quiet machine, what is timed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from joblib import Parallel, delayed, parallel_config
from joblib.externals.loky import get_reusable_executor
from threadpoolctl import threadpool_limits

from diffdrive_mpc.bench.reproduce.experiments.cost import measure_cost
from diffdrive_mpc.bench.reproduce.experiments.mbm_and_sm import MbmSmResult, compare_mbm_and_sm
from diffdrive_mpc.bench.reproduce.experiments.state_space import SsmResult, compare_orders
from diffdrive_mpc.bench.reproduce.experiments.virtual_track import check_virtual_track
from diffdrive_mpc.bench.reproduce.published import load_published
from diffdrive_mpc.bench.reproduce.study import Study

Task = Callable[[], Any]


def count_steps(study: Study, parts: Sequence[str]) -> int:
    """How often `run_parts` calls `on_done`."""
    repeated = sum(part in parts for part in ("ssm", "mbm_sm")) * len(study.repetitions)
    return repeated + 2 * study.cost.runs * ("cost" in parts)


def run_parts(study: Study, parts: Sequence[str], jobs: int, on_done: Callable[[], None]) -> dict[str, Any]:
    """Results by part, as the fields of `bench.reproduce.results.Reproduction`.

    Parameters
    ----------
    study
        What to run.
    parts
        Names of parts.
    jobs
        Processes for the repetitions, one BLAS thread each; no result but the measured times depends on it.
    on_done
        Called after each repetition of a part and each run that is timed.
    """
    # The longest first: a long one at the end would keep one core waiting.
    tasks: list[Task] = [partial(compare_orders, study.ssm, k) for k in study.repetitions if "ssm" in parts]
    tasks += [partial(compare_mbm_and_sm, study.mbm_sm, k) for k in study.repetitions if "mbm_sm" in parts]
    done = _run(tasks, jobs, on_done)
    results: dict[str, Any] = {
        "ssm": tuple(result for result in done if isinstance(result, SsmResult)),
        "mbm_sm": tuple(result for result in done if isinstance(result, MbmSmResult)),
    }
    if "cost" in parts:
        results["cost"] = measure_cost(study.cost, on_done)
    if "virtual_track" in parts:
        results["virtual_track"] = check_virtual_track(load_published().virtual_track)
    return results


def _run(tasks: Sequence[Task], jobs: int, on_done: Callable[[], None]) -> list[Any]:
    if jobs == 1 or len(tasks) < 2:
        with threadpool_limits(limits=1):
            return [_announced(task(), on_done) for task in tasks]
    try:
        with parallel_config(backend="loky", n_jobs=jobs, inner_max_num_threads=1):
            results = Parallel(return_as="generator")(delayed(task)() for task in tasks)
            return [_announced(result, on_done) for result in results]
    finally:
        # Workers that idle would still disturb what is timed afterwards.
        get_reusable_executor().shutdown(wait=True)


def _announced(result: object, on_done: Callable[[], None]) -> object:
    on_done()
    return result
