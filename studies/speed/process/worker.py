"""Process that runs one subject on request: `python worker.py FD KIND FOLDER`.

The process serves a connection at the file descriptor FD; FOLDER contains our package. A request is a pair (method,
arguments), and the reply is the result or the exception. The process imports only the modules of its subject, because
the environment of the peers does not contain all packages.
"""

from __future__ import annotations

import gc
import importlib
import os
import sys
import time
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

KINDS = {
    "ours": ("studies.speed.subjects.ours", "OurSubject"),
    "acados": ("studies.speed.subjects.acados_peer", "AcadosPeer"),
    "do-mpc": ("studies.speed.subjects.do_mpc_peer", "DoMpcPeer"),
    "nlpsol": ("studies.speed.subjects.nlp_peer", "NlpPeer"),
}
"""Module and class of each kind of subject."""

StepTuple = tuple[list[float], float, float, int, bool]
"""Result of a step: command, times of step and solver [s], iterations, and success flag."""


class Worker:
    """Server of one subject; the names of its public methods are the requests."""

    def __init__(self, kind: str) -> None:
        module, name = KINDS[kind]
        self._subject_class = getattr(importlib.import_module(module), name)
        self._subject: Any = None
        # The import path contains our package only after the start of this process, so this import is not at the top.
        self._measure_effort = importlib.import_module("diffdrive_mpc.bench.counters").measure_effort

    def build(self, problem: object, settings: dict[str, Any], folder: str, core: int | None) -> dict[str, float]:
        """Build the subject; return the build time [s] and the memory before the build [bytes]."""
        memory_before, start = _memory_figure("VmRSS"), time.perf_counter()
        os.chdir(folder)
        self._subject = self._subject_class(problem, settings, Path(folder))
        if core is not None:
            os.sched_setaffinity(0, {core})
        gc.collect()
        gc.freeze()
        gc.disable()
        return {"build_s": time.perf_counter() - start, "before_bytes": memory_before}

    def reset(self, *data: object) -> None:
        """Restart a drive with the data of its first tick."""
        self._subject.reset(*data)

    def run(self, *ticks: tuple[object, ...]) -> tuple[list[StepTuple], tuple[float, float, int, float]]:
        """Run a step for each input in `ticks`; return the results and the values of `bench.counters.Effort`."""
        results, effort = self._measure_effort(lambda: [self._time_step(data) for data in ticks])
        return results, tuple(effort)

    def _time_step(self, data: tuple[object, ...]) -> StepTuple:
        start = time.perf_counter()
        command = self._subject.solve(*data)
        whole = time.perf_counter() - start
        return (command.tolist(), whole, *self._subject.report())

    def memory(self) -> float:
        """Return the maximum memory of this process [bytes]."""
        return _memory_figure("VmHWM")


def _memory_figure(field: str) -> float:
    """Return a field of the memory status of this process [bytes]; NaN if the operating system does not provide it."""
    status = Path("/proc/self/status")
    lines = status.read_text(encoding="utf-8").splitlines() if status.is_file() else []
    return next((1024.0 * float(line.split()[1]) for line in lines if line.startswith(field)), float("nan"))


def main() -> None:
    """Serve requests until the client closes the connection."""
    connection = Connection(int(sys.argv[1]))
    try:
        worker = Worker(sys.argv[2])
        connection.send(None)
        while True:
            request, arguments = connection.recv()
            try:
                connection.send(getattr(worker, request)(*arguments))
            except Exception as error:
                connection.send(RuntimeError(f"{type(error).__name__}: {error}"))
    except (EOFError, BrokenPipeError):
        return
    except ImportError as error:
        connection.send(RuntimeError(f"{type(error).__name__}: {error}"))


if __name__ == "__main__":
    # Appended at the end, so that packages of this environment take precedence.
    sys.path[0:1] = []
    sys.path.append(sys.argv[3])
    main()
