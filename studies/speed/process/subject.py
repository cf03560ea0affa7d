"""Client of the process of a subject."""

from __future__ import annotations

import os
import subprocess
import sys
from multiprocessing import Pipe
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, NamedTuple

import diffdrive_mpc
from diffdrive_mpc.bench.counters import Effort
from diffdrive_mpc.models.errors import DiffdriveMpcError

if TYPE_CHECKING:
    from typing import Self

_WORKER = Path(__file__).with_name("worker.py")
_PACKAGES = Path(diffdrive_mpc.__file__).parents[1]
"""Folder of our package, which is not installed in the environment of the peers."""
_ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")


class SubjectError(DiffdriveMpcError, RuntimeError):
    """Error for a subject that cannot run; the message is the reason in one line."""


class TimedStep(NamedTuple):
    """Result of a step: command [m/s, rad/s], times of step and solver [s], iterations, and success flag."""

    command: tuple[float, float]
    whole: float
    inside: float
    iterations: int
    solved: bool


class Subject:
    """Persistent process of a subject, which handles one request at a time.

    Parameters
    ----------
    kind
        Kind of the subject, a key of `studies.speed.process.worker.KINDS`.
    folder
        Folder for the generated code and the output of the subject.
    python
        Python interpreter; by default the interpreter of this process.
    variables
        Additional environment variables.
    """

    def __init__(
        self, kind: str, folder: Path, python: str = sys.executable, variables: dict[str, str] | None = None
    ) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._folder = folder
        self._connection, child_end = Pipe()
        with (folder / "output.txt").open("wb") as output:
            self._process = subprocess.Popen(
                [python, str(_WORKER), str(child_end.fileno()), kind, str(_PACKAGES)],
                pass_fds=[child_end.fileno()],
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                env={**os.environ, **_ONE_THREAD, **(variables or {})},
            )
        child_end.close()

    def __enter__(self) -> Self:
        """Return this object; its process is already running."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End the process."""
        self._connection.close()
        try:
            self._process.wait(timeout=5)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def build(self, problem: object, settings: dict[str, Any], core: int | None) -> dict[str, float]:
        """Build the subject for `problem` and bind it to `core`; return build time [s] and initial memory [bytes].

        Raise SubjectError if the subject cannot be built.
        """
        self._receive()
        return dict(self._request("build", problem, settings, str(self._folder), core))

    def reset(self, data: tuple[Any, ...]) -> None:
        """Restart a drive with the data of its first tick."""
        self._request("reset", *data)

    def run(self, ticks: list[tuple[Any, ...]]) -> tuple[list[TimedStep], Effort]:
        """Run a step for each input in `ticks`; return the results and the effort of the process."""
        steps, effort = self._request("run", *ticks)
        return [TimedStep(*step) for step in steps], Effort(*effort)

    def memory(self) -> float:
        """Return the peak memory of the process so far [bytes]."""
        return float(self._request("memory"))

    def _request(self, request: str, *arguments: object) -> Any:  # noqa: ANN401 - depends on the request
        try:
            self._connection.send((request, arguments))
        except OSError as error:
            raise SubjectError(self._last_output_line()) from error
        return self._receive()

    def _receive(self) -> Any:  # noqa: ANN401 - see above
        try:
            reply = self._connection.recv()
        except (EOFError, OSError) as error:
            raise SubjectError(self._last_output_line()) from error
        if isinstance(reply, Exception):
            raise SubjectError(" ".join(str(reply).split()))
        return reply

    def _last_output_line(self) -> str:
        lines = (self._folder / "output.txt").read_text(encoding="utf-8", errors="replace").split("\n")
        return next((line.strip() for line in reversed(lines) if line.strip()), "the process ended without output")
