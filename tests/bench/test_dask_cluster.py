"""Tasks on a Dask cluster: results equal those of the local pool, and a killed worker loses nothing."""

from __future__ import annotations

import os
import time
from functools import partial

import pandas as pd
import pytest
from bench_parts import quick_case
from dask_cluster import dask_cluster

from diffdrive_mpc import sweep
from diffdrive_mpc.bench import runner
from diffdrive_mpc.bench.controllers import run_case
from diffdrive_mpc.bench.run_row import row_of
from diffdrive_mpc.bench.runner import SchedulerLostError, WorkerDiedError, cluster, run_tasks

SHORT = {"plant": "model:sm", "surface": "ideal", "sensors": "perfect", "trajectory": "cane"}


def position_rmse(seed: int) -> float:
    time.sleep(0.1)
    case = quick_case(seed=seed, sensors="default")
    return float(row_of(case, run_case(case))["position_rmse_m"])


def refuse() -> int:
    raise ValueError("no such plant")


def die() -> int:
    os._exit(9)


def test_killed_worker_loses_no_result_and_results_equal_local_ones() -> None:
    tasks = [partial(position_rmse, seed) for seed in range(8)]
    done: list[int] = []
    with dask_cluster() as (address, processes), cluster(address):

        def kill_a_worker() -> None:
            done.append(1)
            if len(done) == 3:
                processes[1].kill()

        assert run_tasks(tasks, 2, kill_a_worker) == run_tasks(tasks[:4], 1, lambda: None) + [
            task() for task in tasks[4:]
        ]
        assert processes[1].wait() != 0
        assert len(done) == len(tasks)
        distributed = sweep(model=["sm", "ssm"], seeds=2, **SHORT)
        with pytest.raises(ValueError, match="no such plant"):
            run_tasks([refuse], 1, lambda: None)
    pd.testing.assert_frame_equal(distributed, sweep(model=["sm", "ssm"], seeds=2, jobs=2, **SHORT), check_exact=True)


def test_task_that_ends_its_worker_raises_worker_died_error() -> None:
    with (
        dask_cluster(1, DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES="0") as (address, _),
        pytest.raises(WorkerDiedError, match="ended its worker"),
        cluster(address),
    ):
        run_tasks([die], 1, lambda: None)


def test_lost_scheduler_is_one_line() -> None:
    with (
        dask_cluster(1) as (address, processes),
        pytest.raises(SchedulerLostError, match="was lost; start it"),
        cluster(address),
    ):
        run_tasks([partial(position_rmse, seed) for seed in range(8)], 1, processes[0].kill)


def test_absent_scheduler_and_absent_workers_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runner, "_CONNECT", 0.5)
    with (
        pytest.raises(SchedulerLostError, match="tcp://127.0.0.1:9: no answer; start it with"),
        cluster("tcp://127.0.0.1:9"),
    ):
        pass
    monkeypatch.setattr(runner, "_CONNECT", 10.0)
    monkeypatch.setattr(runner, "_WAIT_FOR_WORKERS", 0.5)
    with dask_cluster(0) as (address, _), pytest.raises(SchedulerLostError, match="has no worker"), cluster(address):
        pass
