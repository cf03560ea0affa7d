"""A local Dask cluster of one scheduler and separate worker processes."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager

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
