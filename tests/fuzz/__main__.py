"""`python -m fuzz`: run fuzzers, and leave with 1 if they find anything. See CONTRIBUTING.md."""

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

from fuzz.case import FINDINGS, Fuzzer, save, saved_findings
from fuzz.fuzzers import FUZZERS
from fuzz.runner import check_within_bounds, inside

_LONGEST = 4 * 3600.0
"""Time limit of a number of steps [s]."""
_LONG = 20
"""Cases of a long run, as a multiple of those of a short one."""
_SECONDS = {"short": 20.0, "long": 150.0}
"""Time limit of each fuzzer [s]."""
_CASES_OF_A_PROCESS = 1000


def main() -> None:
    """Read the words, and run."""
    words = _words()
    if words.replay:
        check_within_bounds(FUZZERS[words.replay[0]], saved_findings(words.keep)[tuple(words.replay)])
        return
    if "live" in words.what:
        # It needs ROS, which the others do without.
        from fuzz.live import main as attack

        seconds = words.seconds or {"short": 60.0, "long": 600.0}["long" if "long" in words.what else "short"]
        sys.exit(1 if attack(seconds, words.seed, None if words.keep == FINDINGS else words.keep, words.only) else 0)
    unknown = set(words.what) - {"short", "long", *FUZZERS}
    if unknown:
        sys.exit(f"error: unknown fuzzer '{min(unknown)}': give short, long, or some of {', '.join(FUZZERS)}")
    # One thread for matrices, as in the node: to wake others takes longer than the sums.
    os.environ |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    chosen = [FUZZERS[name] for name in FUZZERS if name in words.what] or list(FUZZERS.values())
    pace = "long" if "long" in words.what else "short"
    sys.exit(int(any([_fuzzed(fuzzer, pace, words) for fuzzer in chosen])))  # noqa: C419 - every fuzzer runs


def _fuzzed(fuzzer: Fuzzer, pace: str, words: argparse.Namespace) -> bool:
    """Search in one process after the other, with the same origins on every machine; return True after a finding."""
    count = fuzzer.count * (_LONG if pace == "long" else 1) if words.count is None else words.count
    limit, steps = _SECONDS[pace], math.inf
    if words.steps is not None:
        count, limit, steps = 10**9, _LONGEST, words.steps
    begun, ran, part = time.monotonic(), {"cases": 0, "steps": 0, "late": 0, "longest_step": 0.0}, 0
    end, code = begun + (limit if words.seconds is None else words.seconds), 0
    while not code and ran["cases"] < count and ran["steps"] < steps and time.monotonic() < end:
        with TemporaryDirectory() as scratch:
            order = f"{fuzzer.name}/{words.seed}/{part}", min(_CASES_OF_A_PROCESS, count), end - time.monotonic()
            process = get_context("spawn").Process(target=inside, args=(fuzzer.name, *order, words.keep, scratch))
            process.start()
            process.join()
            code, part = process.exitcode or 0, part + 1
            account, case = Path(scratch, "account.json"), Path(scratch, "case.json")
            for key, value in json.loads(account.read_text()).items() if account.exists() else ():
                ran[key] = max(ran[key], value) if key == "longest_step" else ran[key] + value
            if code not in (0, 1) and case.exists():
                how = f"killed by {signal.Signals(-code).name}" if code < 0 else f"ended with {code}"
                print(f"  - process {how}\n    {save(fuzzer.name, how, json.loads(case.read_text()), words.keep)}")
        steps_text = "{steps} steps of at most {longest_step:.2f} sample times, {late} late, ".format(**ran)
        print(
            f"{fuzzer.name:12s} seed {words.seed}: {ran['cases']} cases in {time.monotonic() - begun:.0f} s, "
            f"{steps_text if ran['steps'] else ''}{'with findings' if code else 'no finding'}",
            flush=True,
        )
    return bool(code)


def _words() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m fuzz", description=__doc__)
    parser.add_argument("what", nargs="*", help=f"short (default) or long, and some of {', '.join(FUZZERS)}")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", type=int, help="this campaign of `live` alone")
    parser.add_argument("--count", type=int, help="so many cases of each fuzzer")
    parser.add_argument("--steps", type=int, help="of a controller, however many cases that takes")
    parser.add_argument("--seconds", type=float, help="at most so long for each fuzzer")
    parser.add_argument("--keep", type=Path, default=FINDINGS, help="folder for findings")
    parser.add_argument("--replay", nargs=2, metavar=("FUZZER", "MARK"), help="a kept finding, once more")
    return parser.parse_args()


if __name__ == "__main__":
    main()
