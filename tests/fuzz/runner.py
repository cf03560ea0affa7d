"""Runs a fuzzer in a process of its own: bounds of count, time and memory, what it finds made small and kept.

The process may die or hang in compiled code; then its parent knows by the number that it had written down which case
it was, keeps that, and goes on with the next.
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
"""Of addresses, in a whole process: libraries alone reserve 2 GB [byte]."""
_MOST_MORE = 600_000
"""By how much a case may raise the most memory that was ever used [kB]."""
_SMALLER_FOR = 20.0
"""How long a finding is made smaller [s]."""
_KINDS_OF_FINDINGS = 20
"""So many different ones end a run."""
_CASES_OF_A_PROCESS = 1000


def environment() -> dict[str, str]:
    """Of a process that imports the fuzzers, and what they import of other tests."""
    tests = Path(__file__).parents[1]
    paths = [str(tests), str(tests / "models"), str(tests / "mpc"), os.environ.get("PYTHONPATH", "")]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, paths))}


@dataclass(frozen=True)
class Order:
    """What to run: cases `first` to `first + count` of `seed`, for at most `seconds`, and `steps` of the controller."""

    fuzzer: str
    seed: int
    first: int
    count: int
    seconds: float
    steps: float = math.inf

    def words(self) -> str:
        """What to type to repeat the first of them."""
        return f'make fuzz FUZZ="{self.fuzzer} --seed {self.seed} --only {self.first}"'


@dataclass
class Ran:
    """What came of an order: cases begun, what was found in a line or two each, steps of the controller."""

    cases: int = 0
    lines: list[str] = field(default_factory=list)
    steps: int = 0


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
        ran = Ran(ran.cases + part.cases, ran.lines + part.lines, ran.steps + part.steps)
        if died:
            at = Order(order.fuzzer, order.seed, rest.first + part.cases - 1, 1, 600.0)
            ran.lines.append(_kept_death(at, died, folder))
        on_part(ran)
    return ran


def _kept_death(at: Order, died: str, folder: Path) -> str:
    from fuzz.fuzzers import FUZZERS

    finding = Finding(
        at.fuzzer, died, f"{at.fuzzer}: {died.partition(chr(10))[0]}", draw(FUZZERS[at.fuzzer], at.seed, at.first)
    )
    return f"{died}\n    {at.words()}\n    {finding.save(folder)}"


def _in_process(order: Order, folder: Path) -> tuple[Ran, str]:
    """What came of it, and how the process died; empty where it did not."""
    with tempfile.TemporaryDirectory() as scratch:
        report, said = Path(scratch, "report"), Path(scratch, "said")
        with said.open("w") as output:
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
        text = said.read_text(errors="replace")
    steps = max((line["steps"] for line in lines if "steps" in line), default=0)
    ran = Ran(
        max((line.get("begun", 0) for line in lines), default=0),
        [line["found"] for line in lines if "found" in line],
        steps,
    )
    if code == 0:
        return ran, ""
    how = f"killed by {signal.Signals(-code).name}" if code < 0 else f"ended with {code}"
    return replace(ran, cases=max(ran.cases, 1)), f"process {how}\n{text[-3000:]}"


def inside(fuzzer: Fuzzer, order: Order, report: Path, folder: Path) -> None:
    """The process itself: writes lines of what it does to `report`."""
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
            found = judged(fuzzer, case)
            if found is None or found[1] in known:
                continue
            known.add(found[1])
            case, what = smaller(fuzzer, case, *found)
            path = Finding(fuzzer.name, what, found[1], case).save(folder)
            at = Order(order.fuzzer, order.seed, order.first + begun, 1, 0.0)
            out.write(json.dumps({"begun": begun + 1, "found": f"{what}\n    {at.words()}\n    {path}"}) + "\n")
        out.write(json.dumps({"steps": getattr(fuzzer, "steps", 0)}) + "\n")


def judged(fuzzer: Fuzzer, case: Case) -> tuple[str, str] | None:
    """What is wrong with a case, time and memory included."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    try:
        with _bounded(fuzzer.longest):
            found = trouble(fuzzer, case)
    except HangError:
        return f"hangs: it takes longer than {fuzzer.longest:g} s", f"{fuzzer.name}: hangs"
    more = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    if found is None and more > _MOST_MORE:
        return f"memory: it takes {more // 1000} MB", f"{fuzzer.name}: memory"
    return found


def smaller(fuzzer: Fuzzer, case: Case, what: str, signature: str) -> tuple[Case, str]:
    """The smallest case that was found to show the same, and what it shows."""
    end, again = time.monotonic() + _SMALLER_FOR, True
    while again:
        again = False
        for simpler in fuzzer.simpler(case):
            if time.monotonic() > end:
                return case, what
            found = judged(fuzzer, simpler)
            if found is not None and found[1] == signature:
                case, what, again = simpler, found[0], True
                break
    return case, what


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
