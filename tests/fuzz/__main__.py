"""`python -m fuzz`: run fuzzers; the exit status is 1 after a finding. See CONTRIBUTING.md."""

from __future__ import annotations

import argparse
import json
import math
import os
import signal
import sys
import time
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory

from fuzz.case import Fuzzer, save, saved_findings
from fuzz.fuzzers import FUZZERS
from fuzz.runner import check_within_bounds, run_search

_STEPS_TIME_LIMIT = 4 * 3600.0
"""Time limit of a run with --steps [s]."""
_LONG_FACTOR = 20
"""Number of cases of a long run relative to a short run."""
_SECONDS = {"short": 20.0, "long": 150.0}
"""Time limit of each fuzzer [s]."""
_CASES_PER_PROCESS = 1000


def main() -> None:
    """Parse the arguments and run the fuzzers."""
    arguments = _parse_arguments()
    if arguments.replay:
        check_within_bounds(FUZZERS[arguments.replay[0]], saved_findings()[tuple(arguments.replay)])
        return
    if "live" in arguments.what:
        # Only this fuzzer needs ROS.
        from fuzz.live import main as attack

        seconds = arguments.seconds or {"short": 60.0, "long": 600.0}["long" if "long" in arguments.what else "short"]
        sys.exit(1 if attack(seconds, arguments.seed, arguments.only) else 0)
    unknown = set(arguments.what) - {"short", "long", *FUZZERS}
    if unknown:
        sys.exit(f"error: unknown fuzzer '{min(unknown)}': give short, long, or some of {', '.join(FUZZERS)}")
    # One thread for matrices, as in the node: the matrices are too small for more threads.
    os.environ |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    fuzzers = [FUZZERS[name] for name in FUZZERS if name in arguments.what] or list(FUZZERS.values())
    length = "long" if "long" in arguments.what else "short"
    sys.exit(int(any([_run_fuzzer(fuzzer, length, arguments) for fuzzer in fuzzers])))  # noqa: C419 - every fuzzer runs


def _run_fuzzer(fuzzer: Fuzzer, length: str, arguments: argparse.Namespace) -> bool:
    """Search in successive processes, with origins that do not depend on the machine; return True after a finding."""
    count = fuzzer.count * (_LONG_FACTOR if length == "long" else 1) if arguments.count is None else arguments.count
    limit, steps = _SECONDS[length], math.inf
    if arguments.steps is not None:
        count, limit, steps = 10**9, _STEPS_TIME_LIMIT, arguments.steps
    start, totals, index = time.monotonic(), {"cases": 0, "steps": 0, "late": 0, "longest_step": 0.0}, 0
    end, code = start + (limit if arguments.seconds is None else arguments.seconds), 0
    while not code and totals["cases"] < count and totals["steps"] < steps and time.monotonic() < end:
        with TemporaryDirectory() as scratch:
            bounds = f"{fuzzer.name}/{arguments.seed}/{index}", min(_CASES_PER_PROCESS, count), end - time.monotonic()
            process = get_context("spawn").Process(target=run_search, args=(fuzzer.name, *bounds, scratch))
            process.start()
            process.join()
            code, index = process.exitcode or 0, index + 1
            statistics, case = Path(scratch, "statistics.json"), Path(scratch, "case.json")
            for key, value in json.loads(statistics.read_text()).items() if statistics.exists() else ():
                totals[key] = max(totals[key], value) if key == "longest_step" else totals[key] + value
            if code not in (0, 1) and case.exists():
                reason = f"killed by {signal.Signals(-code).name}" if code < 0 else f"ended with {code}"
                path = save(fuzzer.name, reason, json.loads(case.read_text()))
                print(f"  - process {reason}\n    {path}")
        steps_text = "{steps} steps of at most {longest_step:.2f} sample times, {late} late, ".format(**totals)
        print(
            f"{fuzzer.name:12s} seed {arguments.seed}: {totals['cases']} cases in {time.monotonic() - start:.0f} s, "
            f"{steps_text if totals['steps'] else ''}{'with findings' if code else 'no finding'}",
            flush=True,
        )
    return bool(code)


def _parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m fuzz", description=__doc__)
    parser.add_argument("what", nargs="*", help=f"short (default) or long, and some of {', '.join(FUZZERS)}")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", type=int, help="number of the only campaign of `live`")
    parser.add_argument("--count", type=int, help="number of cases of each fuzzer")
    parser.add_argument("--steps", type=int, help="number of steps of the controller, instead of a number of cases")
    parser.add_argument("--seconds", type=float, help="time limit of each fuzzer")
    parser.add_argument("--replay", nargs=2, metavar=("FUZZER", "DIGEST"), help="saved finding to check")
    return parser.parse_args()


if __name__ == "__main__":
    main()
