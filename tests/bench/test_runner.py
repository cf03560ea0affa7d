"""Tasks in a pool of processes."""

import os
import time
from functools import partial
from pathlib import Path

import pytest

from commands import invoke
from diffdrive_mpc.app.cli import app
from diffdrive_mpc.bench.runner import WorkerDiedError, run_tasks


def slow_square(number: int) -> int:
    time.sleep(0.02 * (5 - number))
    return number**2


def raise_value_error() -> int:
    raise ValueError("no such plant")


def exit_process() -> int:
    os._exit(9)


def threads() -> str | None:
    return os.environ.get("OPENBLAS_NUM_THREADS")


@pytest.mark.parametrize("jobs", [1, 2])
def test_results_have_the_order_of_the_tasks(jobs: int) -> None:
    calls: list[int] = []
    assert run_tasks([partial(slow_square, k) for k in range(5)], jobs, lambda: calls.append(1)) == [0, 1, 4, 9, 16]
    assert len(calls) == 5


def test_every_process_has_one_thread() -> None:
    assert run_tasks([threads, threads], 2, lambda: None) == ["1", "1"]


@pytest.mark.parametrize("jobs", [1, 2])
def test_exception_of_a_task_is_raised(jobs: int) -> None:
    with pytest.raises(ValueError, match="no such plant"):
        run_tasks([raise_value_error, raise_value_error], jobs, lambda: None)


def test_killed_process_raises_error_with_a_remedy(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    with pytest.raises(WorkerDiedError, match="killed; try a smaller --jobs"):
        run_tasks([exit_process, exit_process], 2, lambda: None)
    monkeypatch.setattr("diffdrive_mpc.bench.comparison.study._drive", lambda case, whole: exit_process())
    arguments = "--quick --models ssm --trajectories cane,s --plant model:ssm --jobs 2"
    result = invoke(app, "bench", "--out", tmp_path / "out", *arguments.split(), code=1)
    assert result.stderr.startswith("error: one of 2 processes was killed")
    assert result.stderr.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_interruption_ends_the_processes_immediately() -> None:
    def interrupt() -> None:
        raise KeyboardInterrupt

    start = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        run_tasks([partial(slow_square, 5), partial(time.sleep, 60.0)], 2, interrupt)
    assert time.monotonic() - start < 30.0
