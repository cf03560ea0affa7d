"""Run a fuzzer in a process with limits of count, time and memory; save its findings.

The process may die or hang in compiled code. Its report names the case, which the parent saves before the next one.
"""

from __future__ import annotations

import contextlib
import faulthandler
import json
import logging
import math
import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from types import FrameType

from fuzz.case import FINDINGS, Case, Finding, Fuzzer, HangError, draw, trouble

_MOST_MEMORY = 8_000_000_000
"""Address space of a process; libraries alone reserve 2 GB [byte]."""
_MOST_MORE = 600_000
"""Growth of the peak memory that a case may cause [kB]."""
_KINDS_OF_FINDINGS = 20
"""Number of different findings that ends a run."""
_CASES_OF_A_PROCESS = 1000


def environment() -> dict[str, str]:
    """Return the environment of a process that imports the fuzzers and helpers of other tests."""
    tests = Path(__file__).parents[1]
    paths = [str(tests), str(tests / "models"), str(tests / "mpc"), os.environ.get("PYTHONPATH", "")]
    # One thread for matrices, as in the node: to wake others takes longer than the sums.
    threads = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    return {**os.environ, **threads, "PYTHONPATH": os.pathsep.join(filter(None, paths))}


@dataclass(frozen=True)
class Order:
    """Cases to run: `first` to `first + count` of `seed`, for at most `seconds`, and `steps` of the controller."""

    fuzzer: str
    seed: int
    first: int
    count: int
    seconds: float
    steps: float = math.inf

    def words(self) -> str:
        """Return the command that repeats the first case."""
        return f'make fuzz FUZZ="{self.fuzzer} --seed {self.seed} --only {self.first}"'


@dataclass
class Ran:
    """Result of an order: started cases, findings of a line or two each, and steps of the controller.

    `late` steps missed their deadline; the longest one took `longest_step` sample times.
    """

    cases: int = 0
    lines: list[str] = field(default_factory=list)
    steps: int = 0
    late: int = 0
    longest_step: float = 0.0


def run(order: Order, folder: Path = FINDINGS, on_part: Callable[[Ran], None] = lambda _: None) -> Ran:
    """Run an order; `on_part` is called after each process, of which there are several for many cases."""
    end, ran = time.monotonic() + order.seconds, Ran()
    while (
        ran.cases < order.count
        and ran.steps < order.steps
        and time.monotonic() < end
        and len(ran.lines) < _KINDS_OF_FINDINGS
    ):
        count = min(order.count - ran.cases, _CASES_OF_A_PROCESS)
        seconds, steps = end - time.monotonic(), order.steps - ran.steps
        rest = Order(order.fuzzer, order.seed, order.first + ran.cases, count, seconds, steps)
        part, died = _in_process(rest, folder)
        ran = Ran(
            ran.cases + part.cases,
            ran.lines + part.lines,
            ran.steps + part.steps,
            ran.late + part.late,
            max(ran.longest_step, part.longest_step),
        )
        if died:
            single = Order(order.fuzzer, order.seed, rest.first + part.cases - 1, 1, 600.0)
            ran.lines.append(_kept_death(single, died, folder))
        on_part(ran)
    return ran


def _kept_death(order: Order, died: str, folder: Path) -> str:
    from fuzz.fuzzers import FUZZERS

    finding = Finding(
        order.fuzzer,
        died,
        f"{order.fuzzer}: {died.partition(chr(10))[0]}",
        draw(FUZZERS[order.fuzzer], order.seed, order.first),
    )
    return f"{died}\n    {order.words()}\n    {finding.save(folder)}"


def _in_process(order: Order, folder: Path) -> tuple[Ran, str]:
    """Run an order in a process; return its result and its end, which is empty for a normal one."""
    with tempfile.TemporaryDirectory() as scratch:
        report, output_file = Path(scratch, "report"), Path(scratch, "output_file")
        with output_file.open("w") as output:
            words = [sys.executable, "-m", "fuzz", "--inside", json.dumps(asdict(order)), str(report), str(folder)]
            process = subprocess.Popen(
                words, stdin=subprocess.DEVNULL, stdout=output, stderr=output, cwd=scratch, env=environment()
            )
            try:
                # It watches its own time; this is for when it cannot even do that.
                code = process.wait(order.seconds + 600.0)
            except subprocess.TimeoutExpired:
                process.kill()
                code = process.wait()
        lines = [json.loads(line) for line in report.read_text().splitlines()] if report.exists() else []
        text = output_file.read_text(errors="replace")
    account = next((line["account"] for line in lines if "account" in line), {})
    ran = Ran(
        max((line.get("begun", 0) for line in lines), default=0),
        [line["found"] for line in lines if "found" in line],
        **account,
    )
    if code == 0:
        return ran, ""
    how = f"killed by {signal.Signals(-code).name}" if code < 0 else f"ended with {code}"
    return replace(ran, cases=max(ran.cases, 1)), f"process {how}\n{text[-3000:]}"


def inside(fuzzer: Fuzzer, order: Order, report: Path, folder: Path) -> None:
    """Run an order inside the process; write a line per event to `report`."""
    _, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (_MOST_MEMORY, hard))
    warnings.simplefilter("ignore")
    logging.disable(logging.CRITICAL)
    end, known = time.monotonic() + order.seconds, set[str]()
    with report.open("w", buffering=1) as out:
        for begun in range(order.count):
            if time.monotonic() > end or len(known) >= _KINDS_OF_FINDINGS:
                break
            out.write(json.dumps({"begun": begun + 1}) + "\n")
            case = draw(fuzzer, order.seed, order.first + begun)
            fault = judged(fuzzer, case)
            if fault is None or fault[1] in known:
                continue
            known.add(fault[1])
            path = Finding(fuzzer.name, *fault, case).save(folder)
            single = Order(order.fuzzer, order.seed, order.first + begun, 1, 0.0)
            out.write(json.dumps({"begun": begun + 1, "found": f"{fault[0]}\n    {single.words()}\n    {path}"}) + "\n")
        account = {name: getattr(fuzzer, name, 0) for name in ("steps", "late", "longest_step")}
        out.write(json.dumps({"account": account}) + "\n")


def judged(fuzzer: Fuzzer, case: Case) -> tuple[str, str] | None:
    """Check a case, its time and its memory; return description and signature of a fault."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    try:
        with _bounded(fuzzer.longest):
            fault = trouble(fuzzer, case)
    except HangError:
        return f"hangs: it takes longer than {fuzzer.longest:g} s", f"{fuzzer.name}: hangs"
    more = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    if fault is None and more > _MOST_MORE:
        return f"memory: it takes {more // 1000} MB", f"{fuzzer.name}: memory"
    return fault


@contextlib.contextmanager
def _bounded(seconds: float) -> Iterator[None]:
    """Raise HangError after `seconds` in Python; end the process with a traceback where that does not help."""

    def hang(number: int, frame: FrameType | None) -> None:
        raise HangError

    if not hasattr(signal, "SIGALRM"):
        yield
        return
    before = signal.signal(signal.SIGALRM, hang)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    faulthandler.dump_traceback_later(2 * seconds + 30.0, exit=True, file=sys.__stderr__ or 2)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)
        faulthandler.cancel_dump_traceback_later()
