"""Tasks in a pool of processes and on a Dask cluster."""

import os
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import pandas as pd
import pytest
from bench_parts import quick_case

from commands import invoke
from diffdrive_mpc import sweep
from diffdrive_mpc.app.cli import app
from diffdrive_mpc.bench.controllers import run_case
from diffdrive_mpc.bench.run_row import row_of
from diffdrive_mpc.bench.runner import SchedulerLostError, WorkerDiedError, cluster, run_tasks


def slow_square(number: int) -> int:
    time.sleep(0.02 * (5 - number))
    return number**2


def refuse() -> int:
    raise ValueError("no such plant")


def die() -> int:
    os._exit(9)


def threads() -> str | None:
    return os.environ.get("OPENBLAS_NUM_THREADS")


@pytest.mark.parametrize("jobs", [1, 2])
def test_results_come_in_the_order_of_the_tasks(jobs: int) -> None:
    done: list[int] = []
    assert run_tasks([partial(slow_square, k) for k in range(5)], jobs, lambda: done.append(1)) == [0, 1, 4, 9, 16]
    assert len(done) == 5


def test_every_process_has_one_thread() -> None:
    assert run_tasks([threads, threads], 2, lambda: None) == ["1", "1"]


@pytest.mark.parametrize("jobs", [1, 2])
def test_what_a_task_raises_is_raised(jobs: int) -> None:
    with pytest.raises(ValueError, match="no such plant"):
        run_tasks([refuse, refuse], jobs, lambda: None)


def test_a_process_that_dies_is_one_line_with_a_remedy(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    with pytest.raises(WorkerDiedError, match="ended from outside; try a smaller --jobs"):
        run_tasks([die, die], 2, lambda: None)
    monkeypatch.setattr("diffdrive_mpc.bench.comparison.study._drive", lambda case, whole: die())
    arguments = "--quick --models ssm --trajectories cane,s --plant model:ssm --jobs 2"
    result = invoke(app, "bench", "--out", tmp_path / "out", *arguments.split(), code=1)
    assert result.stderr.startswith("error: one of 2 processes was ended from outside")
    assert result.stderr.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_an_interruption_ends_the_processes_at_once() -> None:
    def interrupted() -> None:
        raise KeyboardInterrupt

    began = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        run_tasks([partial(slow_square, 5), partial(time.sleep, 60.0)], 2, interrupted)
    assert time.monotonic() - began < 30.0


SHORT = {"plant": "model:sm", "surface": "ideal", "sensors": "perfect", "trajectory": "cane"}


def position_rmse(seed: int) -> float:
    time.sleep(0.1)
    case = quick_case(seed=seed, sensors="default")
    return float(row_of(case, run_case(case))["position_rmse_m"])


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


def test_lost_scheduler_is_one_line() -> None:
    with (
        dask_cluster(1) as (address, processes),
        pytest.raises(SchedulerLostError, match="was lost; start it"),
        cluster(address),
    ):
        run_tasks([partial(position_rmse, seed) for seed in range(8)], 1, processes[0].kill)


Process = subprocess.Popen[bytes]


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@contextmanager
def dask_cluster(workers: int = 2, **environment: str) -> Iterator[tuple[str, list[Process]]]:
    """Give the address of the scheduler, and its process followed by those of the workers."""
    address = f"tcp://127.0.0.1:{(port := free_port())}"
    scheduler = ("dask_scheduler", "--host", "127.0.0.1", "--port", str(port))
    worker = ("dask_worker", address, "--nthreads", "1", "--no-nanny")
    processes = [
        subprocess.Popen(
            [sys.executable, "-m", f"distributed.cli.{command[0]}", *command[1:], "--no-dashboard"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)} | environment,
        )
        for command in (scheduler, *[worker] * workers)
    ]
    try:
        while socket.socket().connect_ex(("127.0.0.1", port)):
            assert processes[0].poll() is None
            time.sleep(0.2)
        yield address, processes
    finally:
        for process in processes:
            process.kill()
            process.wait()
