"""Search with Hypothesis, with limits of time and memory."""

from __future__ import annotations

import contextlib
import faulthandler
import json
import logging
import resource
import signal
import sys
import time
import traceback
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType

from hypothesis import HealthCheck, example, given, seed, settings
from hypothesis import strategies as st

from fuzz.case import Case, DeadlineError, FaultError, Fuzzer, HangError, draw, save, saved_findings

_MAX_MEMORY = 8_000_000_000
"""Address space of a process; libraries alone reserve 2 GB [byte]."""
_MAX_MEMORY_GROWTH = 600_000
"""Maximum growth of the peak memory during a case [kB]."""


def search(
    fuzzer: Fuzzer,
    origin: str,
    count: int,
    seconds: float = 600.0,
    on_case: Callable[[Case], None] = lambda _: None,
    on_fault: Callable[[Case, BaseException], None] = lambda _case, _error: None,
) -> None:
    """Check the saved findings and `count` cases drawn from `origin`, for at most `seconds`; raise a reduced fault.

    `on_case` is called before each case, and `on_fault` after each fault; its last call has the reduced case.
    """
    end, failed = time.monotonic() + seconds, False

    def check(case: Case) -> None:
        nonlocal failed
        # After the time limit no more cases are drawn, but a fault is still reduced.
        if time.monotonic() > end and not failed:
            return
        on_case(case)
        try:
            check_within_bounds(fuzzer, case)
        except Exception as error:
            failed = True
            on_fault(case, error)
            raise

    cases = st.randoms(use_true_random=False).map(fuzzer.draw)
    if not getattr(fuzzer, "is_reducible", True):
        # Hypothesis starts with the simplest case, which is the same for every origin.
        cases = st.integers(0).map(lambda index: draw(fuzzer, origin, index))
    check = given(cases)(check)
    for (name, _), case in saved_findings().items():
        if name == fuzzer.name:
            check = example(case)(check)
    health = list(HealthCheck)
    bounds = settings(max_examples=count, deadline=None, derandomize=False, database=None, suppress_health_check=health)
    seed(origin)(bounds(check))()


def run_search(name: str, origin: str, count: int, seconds: float, scratch: str) -> None:
    """Search in this process; after a fault, save the reduced case and exit with status 1."""
    from fuzz.fuzzers import FUZZERS

    resource.setrlimit(resource.RLIMIT_AS, (_MAX_MEMORY, resource.getrlimit(resource.RLIMIT_AS)[1]))
    warnings.simplefilter("ignore")
    logging.disable(logging.CRITICAL)
    fuzzer, cases, faults = FUZZERS[name], 0, dict[str, tuple[Case, BaseException]]()

    def note_start(case: Case) -> None:
        nonlocal cases
        cases += 1
        Path(scratch, "case.json").write_text(json.dumps(case))

    def note_fault(case: Case, error: BaseException) -> None:
        frames = traceback.extract_tb(error.__traceback__)
        faults[f"{type(error).__name__} in {frames[-1].name}, line {frames[-1].lineno}"] = case, error

    try:
        search(fuzzer, origin, count, seconds, note_start, note_fault)
    except Exception as error:
        traceback.print_exception(error)
        for location, (case, fault) in faults.items():
            print(f"  - {location}: {fault}\n    {save(name, f'{location}: {fault}', case)}", flush=True)
        sys.exit(1)
    finally:
        statistics = {key: getattr(fuzzer, key, 0) for key in ("steps", "late", "longest_step")}
        Path(scratch, "statistics.json").write_text(json.dumps({"cases": cases, **statistics}))


def _check_twice_if_late(fuzzer: Fuzzer, case: Case) -> None:
    try:
        fuzzer.check(case)
    except DeadlineError:
        fuzzer.check(case)


def check_within_bounds(fuzzer: Fuzzer, case: Case) -> None:
    """Check a case with limits of time and memory; raise FaultError or an error of the project."""
    previous = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    try:
        with _bounded(fuzzer.time_limit):
            _check_twice_if_late(fuzzer, case)
    except HangError:
        raise FaultError(f"hangs: the case takes longer than {fuzzer.time_limit:g} s") from None
    except SystemExit as error:  # raised by a library
        raise FaultError(f"exit: {error}") from error
    growth = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - previous
    if growth > _MAX_MEMORY_GROWTH:
        raise FaultError(f"memory: the case takes {growth // 1000} MB")


@contextlib.contextmanager
def _bounded(seconds: float) -> Iterator[None]:
    """Raise HangError after `seconds` in Python; end the process with a traceback if that fails."""

    def hang(number: int, frame: FrameType | None) -> None:
        raise HangError

    if not hasattr(signal, "SIGALRM"):
        yield
        return
    handler = signal.signal(signal.SIGALRM, hang)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    faulthandler.dump_traceback_later(2 * seconds + 30.0, exit=True, file=sys.__stderr__ or 2)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, handler)
        faulthandler.cancel_dump_traceback_later()
