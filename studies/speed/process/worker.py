"""A process that solves the problem in one way, on request: `python worker.py FD KIND FOLDER`.

It serves a connection at the file descriptor FD; FOLDER holds our package. A request is a pair (what, argument) and its
answer what came of it, or the exception. So that it also runs in a peer's environment, it imports only the necessary
modules of this project.
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
"""Module and class behind each kind of subject."""

Answer = tuple[list[float], float, float, int, bool]
"""Result of a step: command, time of the whole step and inside the solver [s], iterations, solved."""


class Worker:
    """Holds one subject; its public methods can be requested."""

    def __init__(self, kind: str) -> None:
        module, name = KINDS[kind]
        self._make = getattr(importlib.import_module(module), name)
        self._subject: Any = None
        # Not at the top: its folder is on the path only by now.
        self._measure_effort = importlib.import_module("diffdrive_mpc.bench.counters").measure_effort

    def build(self, problem: object, settings: dict[str, Any], folder: str, core: int | None) -> dict[str, float]:
        """Make the subject; returns the time that took [s] and the memory before [bytes]."""
        before, began = _resident("VmRSS"), time.perf_counter()
        os.chdir(folder)
        self._subject = self._make(problem, settings, Path(folder))
        if core is not None:
            os.sched_setaffinity(0, {core})
        gc.collect()
        gc.freeze()
        gc.disable()
        return {"build_s": time.perf_counter() - began, "before_bytes": before}

    def reset(self, *data: object) -> None:
        """Restart a drive; `data` are those of its first tick."""
        self._subject.reset(*data)

    def run(self, *ticks: tuple[object, ...]) -> tuple[list[Answer], tuple[float, float, int, float]]:
        """Step through ticks: an answer for each, and the `bench.counters.Effort` of all."""
        answers, effort = self._measure_effort(lambda: [self._timed(data) for data in ticks])
        return answers, tuple(effort)

    def _timed(self, data: tuple[object, ...]) -> Answer:
        began = time.perf_counter()
        command = self._subject.solve(*data)
        whole = time.perf_counter() - began
        return (command.tolist(), whole, *self._subject.report())

    def memory(self) -> float:
        """Return the maximum memory of this process [bytes]."""
        return _resident("VmHWM")


def _resident(field: str) -> float:
    """Return a memory figure of this process [bytes]; NaN if the system does not provide it."""
    status = Path("/proc/self/status")
    lines = status.read_text(encoding="utf-8").splitlines() if status.is_file() else []
    return next((1024.0 * float(line.split()[1]) for line in lines if line.startswith(field)), float("nan"))


def main() -> None:
    """Serve until the other end closes."""
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
    # Last, so that this environment's own packages come first.
    sys.path[0:1] = []
    sys.path.append(sys.argv[3])
    main()
