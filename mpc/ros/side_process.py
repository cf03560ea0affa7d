"""Separate process for tasks that take longer than a tick, since a thread would delay the control loop.

`python -m diffdrive_mpc.mpc.ros.side_process DESCRIPTOR` starts the process. It executes requests from the socket in
order until the other end of the socket closes.
"""

from __future__ import annotations

import os
import pickle
import socket
import subprocess
import sys
import threading
from collections import OrderedDict
from collections.abc import Callable
from contextlib import suppress
from multiprocessing.connection import Connection
from typing import Any, NamedTuple

_MODULE = "diffdrive_mpc.mpc.ros.side_process"
# Increment of the niceness, so that the process does not delay the control loop.
_NICENESS = 10
_END_TIMEOUT = 2.0
"""Time limit for the end of the process [s]."""
_START_TIMEOUT = 60.0
"""Time limit for the start of the process and the import of the module [s]; the process has a low priority."""
OnDone = Callable[[Any], None]
OnError = Callable[[str], None]


class _Job(NamedTuple):
    function: Callable[..., Any]
    arguments: tuple[Any, ...]
    done: OnDone
    failed: OnError


class SideProcess:
    """Execution of functions in a separate process, in order; only `close` waits for the process.

    The process starts with the first call, which takes about a second.

    Parameters
    ----------
    wake
        Function that is called from a separate thread if `deliver` has results.
    time_limit
        Time limit of a function after the import of its module [s]; after this time the process is killed.
    """

    def __init__(self, wake: Callable[[], None], time_limit: float) -> None:
        self._wake, self._time_limit = wake, time_limit
        self._condition = threading.Condition()
        self._waiting: OrderedDict[str, _Job] = OrderedDict()
        self._results: list[tuple[_Job, bool, Any]] = []
        self._is_closed = False
        self._thread: threading.Thread | None = None
        self._process: subprocess.Popen[bytes] | None = None
        self._link: Connection | None = None

    def submit(
        self, key: str, function: Callable[..., Any], arguments: tuple[Any, ...], done: OnDone, failed: OnError
    ) -> None:
        """Queue `function(*arguments)`; call `done` with the result, or `failed` with the reason for a failure.

        The function must be defined at module level. A waiting job with the same `key` is replaced and fails.
        """
        with self._condition:
            if self._thread is None:
                self._thread = threading.Thread(target=self._serve, name="side process", daemon=True)
                self._thread.start()
            replaced = self._waiting.pop(key, None)
            if replaced is not None:
                self._results.append((replaced, False, "a newer request replaced it"))
            self._waiting[key] = _Job(function, arguments, done, failed)
            self._condition.notify()
        if replaced is not None:
            self._wake()

    def prepare(self, function: Callable[[], Any]) -> None:
        """Start the process and import the module of `function`, if the process was not started before."""
        if self._thread is None:
            self.submit("prepare", function, (), _ignore, _ignore)

    def deliver(self) -> None:
        """Call `done` or `failed` of all completed jobs in the caller's thread."""
        with self._condition:
            results, self._results = self._results, []
        for job, succeeded, content in results:
            (job.done if succeeded else job.failed)(content)

    def close(self) -> None:
        """End the process and discard pending requests."""
        with self._condition:
            self._is_closed = True
            self._condition.notify()
            self._kill_process()
        if self._thread is not None:
            self._thread.join(_END_TIMEOUT)

    def _start_process(self) -> Connection:
        parent_end, child_end = socket.socketpair()
        command = [sys.executable, "-m", _MODULE, str(child_end.fileno())]
        # The separate session keeps Ctrl-C from the process, which otherwise ends before the node.
        self._process = subprocess.Popen(
            command, pass_fds=[child_end.fileno()], stdin=subprocess.DEVNULL, start_new_session=True
        )
        # An open copy of this end would keep the socket open after the end of the process.
        child_end.close()
        self._link = Connection(parent_end.detach())
        return self._link

    def _kill_process(self) -> None:
        if self._process is not None:
            self._process.kill()
            # A killed process ends in any case, so this process need not wait longer.
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(_END_TIMEOUT)
                self._process = None

    def _serve(self) -> None:
        while True:
            with self._condition:
                self._condition.wait_for(lambda: self._waiting or self._is_closed)
                if self._is_closed:
                    break
                _, job = self._waiting.popitem(last=False)
            succeeded, content = self._run_job(job)
            with self._condition:
                if self._is_closed:
                    break
                self._results.append((job, succeeded, content))
            self._wake()
        if self._link is not None:
            self._link.close()

    def _run_job(self, job: _Job) -> tuple[bool, Any]:
        reason = "the process that converts it ended; send it again"
        try:
            link = self._link or self._start_process()
            link.send((job.function, job.arguments))
            reason = f"the process that converts it does not start within {_START_TIMEOUT:g} s"
            # The process replies twice, after the import of the module and with the result; only the second has the
            # time limit of the function.
            if link.poll(_START_TIMEOUT):
                link.recv()
                reason = f"its conversion takes longer than {self._time_limit:g} s"
                if link.poll(self._time_limit):
                    succeeded, content = link.recv()
                    return bool(succeeded), content
        except (OSError, EOFError):
            pass
        except (pickle.PicklingError, TypeError, AttributeError, MemoryError) as error:
            reason = f"it cannot be sent to the process that converts it: {error}"
        with self._condition:
            if self._link is not None and not self._is_closed:
                self._link.close()
                self._link = None
                self._kill_process()
        return False, reason


def _ignore(_: object) -> None:
    """Ignore a result that is not needed."""


def _main(descriptor: int) -> None:
    """Execute requests until the socket closes."""
    os.nice(_NICENESS)
    if hasattr(os, "sched_setscheduler"):
        os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))
    link = Connection(descriptor)
    while True:
        try:
            function, arguments = link.recv()
            link.send("its module is loaded")
            reply = _run_function(function, arguments)
            link.send(reply)
        except (EOFError, OSError):
            return


def _run_function(function: Callable[..., Any], arguments: tuple[Any, ...]) -> tuple[bool, Any]:
    try:
        return True, function(*arguments)
    except ValueError as error:
        return False, str(error)
    except Exception as error:
        return False, f"{type(error).__name__}: {error}"


if __name__ == "__main__":
    _main(int(sys.argv[1]))
